"""What a video's container says of it, without decoding a frame."""

from __future__ import annotations

from pathlib import Path

from hoigs.preparation.video.container import open_video
from hoigs.preparation.video.source import SourceError

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


def missing_frames(path: Path, found: int) -> list[str]:
    """A sentence for the report if a video's header has more frames than were found."""
    header = video_header(path)
    if header is None or found >= MOST * header[0]:
        return []
    return [
        f"the video's header gives {header[0]} frames, {found} were found: the file may be cut off"
    ]
