"""What a container says of a video, and videos that are too large."""

from __future__ import annotations

from pathlib import Path

import pytest
from tiny import FRAMES

from hoigs.preparation.video.container import missing_frames, video_header


def test_a_video_that_is_shorter_than_its_header_says(tiny_video: Path) -> None:
    assert video_header(tiny_video) == (FRAMES, pytest.approx(12))
    assert missing_frames(tiny_video, FRAMES) == []
    (sentence,) = missing_frames(tiny_video, 5)
    assert "12 frames, 5 were found" in sentence


def test_a_file_that_is_no_video_has_no_header(tmp_path: Path) -> None:
    path = tmp_path / "text.mp4"
    path.write_text("no video")
    assert video_header(path) is None
