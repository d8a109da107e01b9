"""One body, one small scene and one small clip for all tests of the generator."""

from __future__ import annotations

from pathlib import Path

import pytest
from jaxtyping import install_import_hook

# kernels is left out, because Warp reads the source of its kernels; knobs is read by pydantic
install_import_hook(
    [
        f"hoigs.synthesis.{name}"
        for name in ("builtin", "clothes", "designs", "generate", "ik", "meshes", "noise",
                     "named", "objects", "paths", "person", "raycast", "room", "textures",
                     "walking")
    ],
    "shapecheck.check",
)  # fmt: skip

from hoigs.plugins.bodies.anny import AnnyBody  # noqa: E402
from hoigs.synthesis import SceneKnobs, SyntheticScene, builtin_clip, generate  # noqa: E402


@pytest.fixture(scope="session")
def body() -> AnnyBody:
    return AnnyBody()


@pytest.fixture(scope="session")
def scene(body: AnnyBody) -> SyntheticScene:
    """The default choreography at 24 frames of 64x64."""
    return generate(SceneKnobs.tiny(frames=24, fps=6.0), body)


@pytest.fixture(scope="session")
def clip_folder(body: AnnyBody, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny clip, generated once into a cache of its own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOIGS_CACHE", str(tmp_path_factory.mktemp("cache")))
        return builtin_clip(body, SceneKnobs.tiny())
