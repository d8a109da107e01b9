"""Frames stream from a video, chosen and resized; damage shows at once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tiny import FRAMES, HEIGHT, WIDTH, picture

from hoigs.preparation.video.frames import Choice, VideoFrames
from hoigs.preparation.video.source import SourceError


def test_all_frames(tiny_video: Path) -> None:
    video = VideoFrames(tiny_video)
    assert (len(video), video.width, video.height, video.fps) == (FRAMES, WIDTH, HEIGHT, 12)
    for _ in range(2):  # every iteration starts anew
        frames = list(video)
        assert len(frames) == FRAMES
        for i, frame in enumerate(frames):
            assert frame.dtype == np.uint8
            assert np.abs(frame.astype(int) - picture(i)).mean() < 6  # 4:2:0 blurs edges


def test_every_and_max_frames(tiny_video: Path) -> None:
    video = VideoFrames(tiny_video, choice=Choice(every=3, max_frames=3))
    assert video.indices == [0, 3, 6] and video.fps == 4
    for i, frame in zip(video.indices, video, strict=True):
        assert np.abs(frame.astype(int) - picture(i)).mean() < 6


def test_width(tiny_video: Path) -> None:
    video = VideoFrames(tiny_video, width=48)
    assert next(iter(video)).shape == (32, 48, 3)
    with pytest.raises(SourceError, match="video's 96"):
        VideoFrames(tiny_video, width=97)


def test_empty_and_damaged_videos(tiny_video: Path, tmp_path: Path) -> None:
    empty = tmp_path / "empty.mp4"
    empty.write_bytes(b"")
    with pytest.raises(SourceError, match=r"empty\.mp4.*0 bytes"):
        VideoFrames(empty)
    half = tmp_path / "half.mp4"
    half.write_bytes(tiny_video.read_bytes()[:400])
    with pytest.raises(SourceError):
        VideoFrames(half)
    text = tmp_path / "text.mp4"
    text.write_text("this is no video")
    with pytest.raises(SourceError):
        VideoFrames(text)
