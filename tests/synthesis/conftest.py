"""One body, one small scene and one small clip for all tests of the generator."""

from __future__ import annotations

from pathlib import Path

import pytest
from jaxtyping import install_import_hook

# not `kernels`, since Warp reads the source of its kernels, nor `config`, which pydantic reads
install_import_hook(
    [
        f"hoigs.synthesis.{name}"
        for name in ("builtin", "generate", "named", "motion.object_motions",
                     "motion.object_script", "motion.ik", "motion.walking",
                     "degradation.damage", "degradation.noise", "person.choreography",
                     "person.clothes", "rendering.paths",
                     "rendering.raycast", "degradation.shutter", "room.designs", "room.meshes",
                     "room.room", "room.textures")
    ],
    "shapecheck.check",
)  # fmt: skip

from hoigs.plugins.bodies.anny import AnnyBody  # noqa: E402
from hoigs.synthesis import SceneConfig, SyntheticScene, builtin_clip, generate  # noqa: E402


@pytest.fixture(scope="session")
def body() -> AnnyBody:
    return AnnyBody()


@pytest.fixture(scope="session")
def scene(body: AnnyBody) -> SyntheticScene:
    """The default choreography at 24 frames of 64x64."""
    return generate(SceneConfig.tiny(frames=24, fps=6.0), body)


@pytest.fixture(scope="session")
def clip_folder(body: AnnyBody, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny clip, generated once into a cache of its own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOIGS_CACHE", str(tmp_path_factory.mktemp("cache")))
        return builtin_clip(body, SceneConfig.tiny())
