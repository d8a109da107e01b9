"""What a container says of a video, and videos that are too large."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest
from tiny import FRAMES

from hoigs.preparation.video.container import hidden_frames, missing_frames, video_header


def test_a_video_that_is_shorter_than_its_header_says(tiny_video: Path) -> None:
    assert video_header(tiny_video) == (FRAMES, pytest.approx(12))
    assert missing_frames(tiny_video, FRAMES) == []
    (sentence,) = missing_frames(tiny_video, 5)
    assert "12 frames, 5 were found" in sentence


def test_frames_that_an_edit_list_hides_are_not_missing(tmp_path: Path) -> None:
    """A phone cuts a video by saying where to begin to show it."""
    path, shown, hidden = tmp_path / "cut.mp4", 25, 15
    with av.open(str(path), "w", options={"avoid_negative_ts": "disabled"}) as container:
        stream = container.add_stream("h264", rate=25, options={"bf": "0"})
        stream.width = stream.height = 64
        packets = []
        for i in range(shown + hidden):
            image = np.full((64, 64, 3), 5 * i, np.uint8)
            packets += stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24"))
        for packet in (*packets, *stream.encode()):
            packet.pts -= round(hidden / 25 / packet.time_base)
            packet.dts = packet.pts
            container.mux(packet)
    header = video_header(path)
    assert header is not None and header[0] == shown + hidden
    assert hidden_frames(path) == hidden and missing_frames(path, shown) == []
    assert len(missing_frames(path, 10)) == 1  # fewer than are shown: it is cut off


def test_a_header_that_has_the_length_of_the_file_alone(tmp_path: Path) -> None:
    """Matroska counts no frames: the plan's times were unknown."""
    path = tmp_path / "video.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("h264", rate=25)
        stream.width = stream.height = 64
        for i in range(50):
            image = np.full((64, 64, 3), 5 * i, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
    assert video_header(path) is None and missing_frames(path, 1) == []
    header = video_header(path, about=True)
    assert header is not None and header[0] == pytest.approx(50, abs=2)


def test_a_file_that_is_no_video_has_no_header(tmp_path: Path) -> None:
    path = tmp_path / "text.mp4"
    path.write_text("no video")
    assert video_header(path) is None
