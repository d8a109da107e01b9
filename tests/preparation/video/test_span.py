"""--start and --end: a part of a video, whose frames keep their numbers and true times."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from tiny import FRAMES, picture

from hoigs.core.errors import SpecError
from hoigs.preparation.options import PrepareOptions
from hoigs.preparation.video.container import missing_frames
from hoigs.preparation.video.frames import Choice, VideoFrames
from hoigs.preparation.video.source import SourceError
from hoigs.preparation.video.span import Place, Span, parse_place


def write(path: Path, ticks: list[int], turned: float = 0.0) -> Path:
    """A video whose frames, of growing brightness, are shown at these multiples of 1/300 s."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("h264", rate=30)
        stream.width, stream.height = 64, 48
        stream.time_base = stream.codec_context.time_base = Fraction(1, 300)
        if turned:
            stream.set_display_rotation(turned)
        for i, tick in enumerate(ticks):
            image = np.full((48, 64, 3), 40 + 8 * i, np.uint8)
            image[:10, :10] = 255  # top left
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = tick, Fraction(1, 300)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("2.5", Place(2.5)), (2.5, Place(2.5)), ("1:02.5", Place(62.5)), ("1:00:01", Place(3601)),
        ("75f", Place(75, True)), (".5s", Place(0.5)),
    ],
)  # fmt: skip
def test_places(text: str | float, place: Place) -> None:
    assert parse_place(text, "--start") == place


@pytest.mark.parametrize("text", ["-1", "soon", "1:2:3:4", "7.5f", ""])
def test_no_places(text: str) -> None:
    with pytest.raises(SpecError):
        parse_place(text, "--start")


def test_a_part_keeps_the_videos_numbers_and_times(tiny_video: Path) -> None:
    part = VideoFrames(tiny_video, choice=Choice(span=Span.of(0.25, "10f")))  # 12 frames a second
    assert part.indices == [3, 4, 5, 6, 7, 8, 9]
    assert part.times == pytest.approx([i / 12 for i in part.indices], abs=1e-3)
    assert np.abs(next(iter(part)).astype(int) - picture(3)).mean() < 6
    both = VideoFrames(tiny_video, choice=Choice(every=2, max_frames=3, span=Span.of("3f", None)))
    assert both.indices == [3, 5, 7] and both.fps == 6 and both.list.first == 3
    assert VideoFrames(tiny_video, choice=Choice(fps=4, span=Span.of(0.25, None))).indices == [
        3,
        6,
        9,
    ]
    assert VideoFrames(tiny_video, choice=Choice(span=Span.of(None, 99))).total == FRAMES


def test_parts_that_are_none(tiny_video: Path) -> None:
    for start, end in ((9, 2.5), ("3f", "3f"), (None, 0)):
        with pytest.raises(ValueError, match=r"--end .*--start"):
            PrepareOptions(start=start, end=end)
    with pytest.raises(SourceError, match=r"--start 7 s.* 0 to 11, .* 0\.92 s"):
        VideoFrames(tiny_video, choice=Choice(span=Span.of(7, None)))
    with pytest.raises(SourceError, match="--start"):
        VideoFrames(tiny_video, choice=Choice(span=Span.of("6f", 0.1)))


def test_frames_of_a_variable_rate_keep_their_times(tmp_path: Path) -> None:
    ticks = [600 + 10 * i + (i // 3) * 25 for i in range(12)]  # begins at 2 s, as cut videos may
    video = VideoFrames(write(tmp_path / "uneven.mp4", ticks))
    assert video.times == pytest.approx([(t - 600) / 300 for t in ticks])
    assert video.uneven and video.fps == pytest.approx(11 / video.times[-1])
    assert VideoFrames(video.path, choice=Choice(span=Span.of(0.2, None))).indices[0] == 4
    even = VideoFrames(write(tmp_path / "even.mp4", [10 * i for i in range(12)]))
    some = even.subset([0, 1, 2, 7])
    assert not even.uneven and some.uneven and video.variable and not some.variable


def test_a_phones_upright_video(tmp_path: Path) -> None:
    """The container's display matrix, as phones write it, is obeyed by size and pixels."""
    video = VideoFrames(write(tmp_path / "turned.mp4", [0, 10, 20], turned=-90))
    assert (video.width, video.height) == (48, 64)
    corner = np.unravel_index(next(iter(video))[..., 0].argmax(), (64, 48))
    assert corner[0] < 12 and corner[1] > 36, "a quarter turn clockwise: now at the top right"


def test_a_video_that_is_cut_off(tmp_path: Path) -> None:
    path, rng = tmp_path / "cut.mp4", np.random.default_rng(0)
    with av.open(str(path), "w", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("h264", rate=24)
        stream.width, stream.height = 64, 48
        for _ in range(20):
            noise = rng.integers(0, 255, (48, 64, 3), dtype=np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(noise, format="rgb24")))
        container.mux(stream.encode())
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    found = VideoFrames(path).total
    assert 5 < found < 20
    (sentence,) = missing_frames(path, found)
    assert f"gives 20 frames, {found} were found: the file may be cut off" in sentence
