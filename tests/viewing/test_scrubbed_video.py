"""Frames in any order are those of a pass through the video."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from hoigs.core.errors import HoigsError
from hoigs.preparation.video.frames import VideoFrames
from hoigs.viewing.annotate.video import ScrubbedVideo


def test_any_order(tmp_path: Path) -> None:
    path = tmp_path / "v.mp4"
    with av.open(str(path), "w") as out:
        stream = out.add_stream("libx264", 10, {"g": "7", "bf": "2", "crf": "10"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for i in range(30):
            image = np.full((48, 64, 3), 8 * i, np.uint8)
            frame = av.VideoFrame.from_ndarray(image, "rgb24")
            frame.pts, frame.time_base = i + i * i // 10, Fraction(1, 10)  # uneven
            out.mux(stream.encode(frame))
        out.mux(stream.encode())
    straight = list(VideoFrames(path))
    video = ScrubbedVideo(path)
    assert (video.count, video.width, video.height) == (30, 64, 48) and len(video.keyframes) > 3
    for number in (29, 3, 17, 16, 4, 0, 28, 5, 11):
        assert np.array_equal(video.rgb(number), straight[number]), number
    with pytest.raises(HoigsError, match="0 to 29"):
        video.picture(30)
    video.close()
