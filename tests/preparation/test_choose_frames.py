"""How wide the frames of a video are stored."""

from __future__ import annotations

import pytest

from hoigs.preparation.stages import stored_width
from hoigs.preparation.video.frames import FrameList


@pytest.mark.parametrize(
    ("size", "width"), [((3840, 2160), 1280), ((2160, 3840), 720), ((1920, 1080), None)]
)
def test_large_frames_are_stored_smaller(size: tuple[int, int], width: int | None) -> None:
    found = FrameList(*size, 60.0, 60.0, 3, [0, 1, 2], [1.0] * 3)
    stored, notes = stored_width(found)
    assert stored == width
    assert len(notes) == (width is not None)
    assert all(f"frames of {size[0]}x{size[1]} are stored at a width of" in n for n in notes)
