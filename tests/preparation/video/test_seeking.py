"""A start in the middle: the frames are those of a pass from the beginning, to the last bit."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from hoigs.preparation.video import frames as frames_module
from hoigs.preparation.video.frames import Choice, open_frames
from hoigs.preparation.video.span import Span

COUNT, WIDTH, HEIGHT = 60, 64, 48


def write(path: Path, *, bframes: int, uneven: bool, container: str = "mp4") -> None:
    import av

    rng = np.random.default_rng(0)
    with av.open(str(path), "w") as out:
        options = {"bf": str(bframes), "g": "8", "x264-params": "open-gop=1:keyint=8"}
        stream = out.add_stream("libx264", rate=30, options=options)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 600)
        at = 0
        for i in range(COUNT):
            pixels = np.full((HEIGHT, WIDTH, 3), 3 * i + 20, np.uint8)
            pixels[:, i : i + 4] = rng.integers(0, 255, 3)
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            frame.pts, frame.time_base = at, Fraction(1, 600)
            at += 20 + (37 * i % 31 if uneven else 0)
            out.mux(stream.encode(frame))
        out.mux(stream.encode())


@pytest.mark.parametrize(
    ("bframes", "uneven", "suffix"),
    [(0, False, "mp4"), (3, False, "mp4"), (3, True, "mp4"), (3, True, "mkv"), (0, False, "avi")],
)
def test_frames_are_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bframes: int, uneven: bool, suffix: str
) -> None:
    path = tmp_path / f"video.{suffix}"
    write(path, bframes=bframes, uneven=uneven)
    spans = [Span.of("27f", "40f"), Span.of(1.01, None), Span.of("1f", "3f"), Span.of("59f", None)]
    sought = [open_frames(path, choice=Choice(every=2, span=span)) for span in spans]
    images = [list(frames) for frames in sought]
    with monkeypatch.context() as patch:  # every pass from the first frame
        patch.setattr(frames_module, "packet_index", lambda *_: None)
        for span, found, given in zip(spans, sought, images, strict=True):
            plain = open_frames(path, choice=Choice(every=2, span=span))
            assert plain.list == found.list and len(plain) > 0
            assert all((a == b).all() for a, b in zip(plain, given, strict=True))
            assert plain.count() == found.count() == COUNT
        every = list(open_frames(path))
    for number in (50, 12, 13, 58, 0, 33):
        assert (sought[0].read(number) == every[number]).all()


def test_nothing_before_the_keyframe_is_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "video.mp4"
    write(path, bframes=2, uneven=False)
    decoded = []
    monkeypatch.setattr(frames_module, "VideoPicture", _counted(decoded))
    frames = open_frames(path, choice=Choice(span=Span.of("42f", "45f")))
    list(frames)
    assert frames.indices == [42, 43, 44] and len(decoded) <= 8


def _counted(decoded: list[int]):
    real = frames_module.VideoPicture

    def made(frame, aspect):
        decoded.append(frame.pts)
        return real(frame, aspect)

    return made


def test_an_index_that_is_wrong_is_noted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "video.mp4"
    write(path, bframes=0, uneven=False)
    right = list(open_frames(path, choice=Choice(span=Span.of("27f", "40f"))))
    index = frames_module.packet_index

    def shifted(*arguments: object) -> object:
        found = index(*arguments)  # type: ignore[arg-type]
        return found and replace(found, times=[time + 7 for time in found.times])

    monkeypatch.setattr(frames_module, "packet_index", shifted)
    frames = open_frames(path, choice=Choice(span=Span.of("27f", "40f")))
    assert all((a == b).all() for a, b in zip(right, frames, strict=True))
    assert len(frames.notes) == 1 and "decoded from the start" in frames.notes[0]
