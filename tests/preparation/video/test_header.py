"""What a container says of a video, and videos that are too large."""

from __future__ import annotations

from pathlib import Path

import pytest
from tiny import FRAMES

from hoigs.preparation.choose_frames import stored_width
from hoigs.preparation.video.frames import FrameList
from hoigs.preparation.video.header import missing_frames, video_header


def test_a_video_that_is_shorter_than_its_header_says(tiny_video: Path) -> None:
    assert video_header(tiny_video) == (FRAMES, pytest.approx(12))
    assert missing_frames(tiny_video, FRAMES) == []
    (sentence,) = missing_frames(tiny_video, 5)
    assert "12 frames, 5 were found" in sentence


def test_a_file_that_is_no_video_has_no_header(tmp_path: Path) -> None:
    path = tmp_path / "text.mp4"
    path.write_text("no video")
    assert video_header(path) is None


@pytest.mark.parametrize(
    ("size", "width"), [((3840, 2160), 1280), ((2160, 3840), 720), ((1920, 1080), None)]
)
def test_large_frames_are_stored_smaller(size: tuple[int, int], width: int | None) -> None:
    found = FrameList(*size, 60.0, 60.0, 3, [0, 1, 2], [1.0] * 3)
    stored, notes = stored_width(found)
    assert stored == width
    assert len(notes) == (width is not None)
    assert all(f"frames of {size[0]}x{size[1]} are stored at a width of" in n for n in notes)
