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
