"""What a container says of a video, and videos that are too large."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pytest

from hoigs.preparation.pipeline import Pipeline
from hoigs.preparation.video.frames import FrameList
from hoigs.preparation.video.header import uneven_times, video_header


def write(path: Path, times: list[int]) -> Path:
    """A video whose frames are shown at these multiples of 1/300 s."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("h264", rate=30)
        stream.width, stream.height = 64, 48
        stream.time_base = stream.codec_context.time_base = Fraction(1, 300)
        for time in times:
            frame = av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8), format="rgb24")
            frame.pts, frame.time_base = time, Fraction(1, 300)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def test_a_variable_frame_rate_is_named(tmp_path: Path) -> None:
    even = write(tmp_path / "even.mp4", [10 * i for i in range(20)])
    assert uneven_times(even, 30.0) == []
    assert video_header(even) == (20, pytest.approx(30.0, rel=0.06))
    uneven = write(tmp_path / "uneven.mp4", [10 * i + (i // 3) * 25 for i in range(20)])
    (sentence,) = uneven_times(uneven, 30.0)
    assert "variable frame rate (32 % of the gaps" in sentence and "ffmpeg" in sentence


def test_a_file_that_is_no_video_has_no_header(tmp_path: Path) -> None:
    path = tmp_path / "text.mp4"
    path.write_text("no video")
    assert video_header(path) is None


@pytest.mark.parametrize(
    ("size", "width"), [((3840, 2160), 1280), ((2160, 3840), 720), ((1920, 1080), None)]
)
def test_large_frames_are_stored_smaller(size: tuple[int, int], width: int | None) -> None:
    run = SimpleNamespace(warnings=[])
    found = FrameList(*size, 60.0, 60.0, 3, [0, 1, 2], [1.0] * 3)
    assert Pipeline._smaller_width(run, found) == width
    assert bool(run.warnings) == (width is not None)
