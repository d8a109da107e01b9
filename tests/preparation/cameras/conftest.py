"""A video of the tiny scene, half as wide and every second frame."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from hoigs.preparation.video.frames import Choice, Frames, open_frames
from tests.preparation.tiny import FRAMES, WIDTH, picture


@pytest.fixture
def video(tmp_path: Path) -> Frames:
    (tmp_path / "frames").mkdir()
    for i in range(FRAMES):
        Image.fromarray(picture(i)).save(tmp_path / f"frames/{i:05d}.png")
    return open_frames(tmp_path / "frames", WIDTH // 2, choice=Choice(every=2))
