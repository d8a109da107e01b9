"""The built-in clip at its smallest, to be exported to each layout and read back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from hoigs.core.values.clip import Clip


@pytest.fixture(scope="session")
def builtin(tmp_path_factory: pytest.TempPathFactory) -> Clip:
    """Eight frames of 32x32 with human, object, depth and exact cameras; two are for tests."""
    return tiny_clip(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="session")
def still(tmp_path_factory: pytest.TempPathFactory) -> Clip:
    """As `builtin`, from a camera that stands still."""
    return tiny_clip(tmp_path_factory.mktemp("still"), camera={"path": "static"})


def tiny_clip(cache: Path, **changes: Any) -> Clip:
    """The built-in clip at its smallest, made in a cache of its own."""
    from hoigs.plugins.bodies.anny import AnnyBody
    from hoigs.plugins.readers.clip import ClipFolderReader
    from hoigs.synthesis import SceneConfig, builtin_clip

    small: dict[str, Any] = {
        "frames": 8, "width": 32, "height": 32, "fps": 2.0, "held_out_views": 0, "test_frames": 2,
        "scene_points": 200,
    }  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOIGS_CACHE", str(cache))
        folder = builtin_clip(AnnyBody(), SceneConfig.tiny(**small, **changes))
    return ClipFolderReader().read(folder)
