"""A video file, opened."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hoigs.preparation.video.source import SourceError, require_regular


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


def missing_frames(path: Path, found: int) -> list[str]:
    """A sentence for the report if a video's header has more frames than were found."""
    header = video_header(path)
    if header is None or found >= MOST * header[0]:
        return []
    return [
        f"the video's header gives {header[0]} frames, {found} were found: the file may be cut off"
    ]
