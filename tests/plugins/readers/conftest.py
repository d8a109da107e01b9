"""The built-in clip at its smallest, to be exported to each layout and read back."""

from __future__ import annotations

from pathlib import Path

import pytest

from hoigs.core.clip import Clip


@pytest.fixture(scope="session")
def builtin(tmp_path_factory: pytest.TempPathFactory) -> Clip:
    """Eight frames of 32x32 with human, object, depth and exact cameras; two are for tests."""
    from hoigs.plugins.bodies.anny import AnnyBody
    from hoigs.plugins.readers.clip import ClipFolderReader
    from hoigs.synthesis import SceneKnobs, builtin_clip

    knobs = SceneKnobs.tiny(
        frames=8, width=32, height=32, fps=2.0, held_out_views=0, test_frames=2, scene_points=200
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOIGS_CACHE", str(tmp_path_factory.mktemp("cache")))
        folder: Path = builtin_clip(AnnyBody(), knobs)
    return ClipFolderReader().read(folder)
