"""A video file, opened."""

from __future__ import annotations

import bisect
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from hoigs.core.errors import SpecError
from hoigs.preparation.video.source import SourceError, require_regular

Pick = Literal["sharpest", "first"]  # which frame of each n


def open_video(path: Path) -> tuple[Any, Any]:
    """PyAV's container, which the caller closes, and its first video stream.

    Raises:
        SourceError: it is no regular file, no video, or has no video stream.
    """
    import av

    require_regular(path)
    try:
        container = av.open(str(path))
    except (av.error.FFmpegError, ValueError) as error:
        raise unreadable(path, error) from error
    if not container.streams.video:
        kinds = " and ".join(sorted({stream.type for stream in container.streams})) or "nothing"
        container.close()
        raise SourceError(f"{path} has no video stream, {kinds} only")
    stream = container.streams.video[0]
    stream.thread_type = "AUTO"
    return container, stream


def unreadable(path: Path, error: Exception) -> SourceError:
    """What is said of a file that the decoder refuses."""
    size = path.stat().st_size if path.exists() else 0
    return SourceError(
        f"{path} ({size} bytes) is not a readable video: {error}; "
        "re-encode it, for example with `ffmpeg -i VIDEO -c:v libx264 fixed.mp4`"
    )


# What a video's container says of it, without decoding a frame.

MOST = 0.97  # of the header's frames, which are an estimate where it gives seconds only


def video_header(path: Path) -> tuple[int, float] | None:
    """Number of frames and frames a second, as the header has them; None if it has not."""
    import av

    try:
        container, stream = open_video(path)
        with container:
            rate = float(stream.average_rate or 0)
            seconds = float((stream.duration or 0) * (stream.time_base or 0))
            count = stream.frames or round(seconds * rate)
            return (count, rate) if count and rate else None
    except (av.error.FFmpegError, SourceError, ValueError):
        return None


def hidden_frames(path: Path) -> int:
    """Number of frames in a video that its edit list does not show."""
    container, stream = open_video(path)
    with container:
        packets = (packet for packet in container.demux(stream) if packet.size)
        return sum(bool(getattr(packet, "is_discard", False)) for packet in packets)


def missing_frames(path: Path, found: int) -> list[str]:
    """A sentence for the report if a video's header has more frames than were found, and than its
    edit list hides: phones and cutting programs leave frames in a file that are not shown."""
    header = video_header(path)
    if header is None or found >= MOST * header[0]:
        return []
    if found + hidden_frames(path) >= MOST * header[0]:
        return []
    return [
        f"the video's header gives {header[0]} frames, {found} were found: the file may be cut off"
    ]


SLACK = 1e-3  # seconds: containers round times to their ticks
_FRAME = re.compile(r"(\d+)f")
_CLOCK = re.compile(r"(?:(?:(\d+):)?(\d{1,2}):)?(\d+(?:\.\d*)?|\.\d+)s?")
HOW = (
    '"2.5" is in seconds from the first frame, "1:02.5" in minutes and seconds, "75f" is frame '
    "75, counted from 0"
)


@dataclass(frozen=True)
class Place:
    """A place in a video.

    Attributes:
        value: seconds since the first frame, or a frame's number. in_frames: which of both.
    """

    value: float
    in_frames: bool = False

    def reached(self, number: int, seconds: float) -> bool:
        """Whether a frame, shown at `seconds`, is at this place or behind it."""
        return number >= self.value if self.in_frames else seconds >= self.value - SLACK

    def __str__(self) -> str:
        return f"frame {self.value:g}" if self.in_frames else f"{self.value:g} s"


def parse_place(text: str | float, what: str) -> Place:
    """A place as it is written: 2.5, "2.5", "1:02.5" or "75f".

    Raises:
        SpecError: it is none of these; `what` names it.
    """
    text = str(text).strip()
    if found := _FRAME.fullmatch(text):
        return Place(int(found[1]), in_frames=True)
    if found := _CLOCK.fullmatch(text):
        hours, minutes, seconds = (float(part or 0) for part in found.groups())
        return Place(3600 * hours + 60 * minutes + seconds)
    raise SpecError(f"{what} {text!r} is no place in a video; {HOW}")


@dataclass(frozen=True)
class Span:
    """From `start` on, until before `end`; None: the video's own."""

    start: Place | None = None
    end: Place | None = None

    @staticmethod
    def of(start: str | float | None, end: str | float | None) -> Span:
        """A span as options and flags give it.

        Raises:
            SpecError: a place cannot be read, or the end does not come after the start.
        """
        span = Span(
            None if start is None else parse_place(start, "--start"),
            None if end is None else parse_place(end, "--end"),
        )
        first, last = span.start or Place(0.0), span.end
        same = last is not None and (span.start is None or first.in_frames == last.in_frames)
        if last is not None and same and last.value <= first.value:
            raise SpecError(f"--end {last} does not come after --start {first}: no frame is left")
        return span

    def begun(self, number: int, seconds: float) -> bool:
        return self.start is None or self.start.reached(number, seconds)

    def over(self, number: int, seconds: float) -> bool:
        return self.end is not None and self.end.reached(number, seconds)

    def __str__(self) -> str:
        start = "" if self.start is None else f"--start {self.start}"
        end = "" if self.end is None else f"--end {self.end}"
        return f"{start} {end}".strip()


# Where each frame of a video file is, by the container's packets, without decoding any.


@dataclass(frozen=True)
class PacketIndex:
    """Times of a video's frames in the order in which they are shown.

    Attributes:
        times: in ticks of the stream. keyframes: numbers of frames that decode by themselves.
        tick: seconds.
    """

    times: list[int]
    keyframes: list[int]
    tick: float

    def __len__(self) -> int:
        return len(self.times)

    def keyframe(self, number: int) -> int:
        """The nearest keyframe at or before a frame."""
        return self.keyframes[max(0, bisect.bisect_right(self.keyframes, number) - 1)]

    def number(self, time: int | None) -> int | None:
        """Of the frame that is shown at a time; None: there is none."""
        at = -1 if time is None else bisect.bisect_left(self.times, time)
        return at if 0 <= at < len(self.times) and self.times[at] == time else None

    def seconds(self, number: int) -> float:
        """Since the first frame."""
        return (self.times[number] - self.times[0]) * self.tick


def packet_index(container: Any, stream: Any) -> PacketIndex | None:
    """The index of an open video; None where packets have no times, or share them, so that frames
    are found by counting alone."""
    shown = [p for p in container.demux(stream) if p.size and not getattr(p, "is_discard", False)]
    packets = sorted((p.pts, p.is_keyframe) for p in shown if p.pts is not None)
    times = [time for time, _ in packets]
    if not packets or len(set(times)) < len(shown) or not packets[0][1]:
        return None
    keyframes = [i for i, (_, key) in enumerate(packets) if key]
    return PacketIndex(times, keyframes, float(stream.time_base or 0))
