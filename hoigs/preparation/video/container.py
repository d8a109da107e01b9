"""A video file, opened."""

from __future__ import annotations

import bisect
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hoigs.core.system.video_files import pyav
from hoigs.preparation.video.source import SourceError, require_regular


def open_video(path: Path) -> tuple[Any, Any]:
    """PyAV's container, which the caller closes, and its first video stream.

    Raises:
        SourceError: it is no regular file, no video, or has no video stream.
    """
    av = pyav()

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


def video_header(path: Path, about: bool = False) -> tuple[int, float] | None:
    """Number of frames and frames a second, as the header has them; None if it has not.

    Args:
        about: where the header has the length of the whole file alone, as Matroska's and WebM's
            have, take it for that of the video. Sound may be longer.
    """
    av = pyav()

    try:
        container, stream = open_video(path)
        with container:
            rate = float(stream.average_rate or 0)
            seconds = float((stream.duration or 0) * (stream.time_base or 0))
            if about and not seconds:
                seconds = (container.duration or 0) / av.time_base
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
