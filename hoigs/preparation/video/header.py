"""What a video's container says of it, without decoding a frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

UNEVEN = 1.5  # a gap between frames this many times as long as the middle one is not even
FEW = 0.02  # of the gaps: a frame dropped now and then is nothing


def video_header(path: Path) -> tuple[int, float] | None:
    """Number of frames and frames a second, as the header has them; None if it has not."""
    import av

    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            rate = float(stream.average_rate or 0)
            seconds = float((stream.duration or 0) * (stream.time_base or 0))
            count = stream.frames or round(seconds * rate)
            return (count, rate) if count and rate else None
    except (av.error.FFmpegError, IndexError, ValueError):
        return None


def uneven_share(path: Path) -> float:
    """Part of the gaps between a video's frames that are not of one length, 0..1."""
    import av

    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        times = sorted(p.pts for p in container.demux(stream) if p.pts is not None)
    gaps = np.diff(times)
    if len(gaps) < 2:
        return 0.0
    middle = float(np.median(gaps))
    return float(((gaps > UNEVEN * middle) | (gaps * UNEVEN < middle)).mean())


def uneven_times(path: Path, fps: float) -> list[str]:
    """A sentence for the report if a video has a variable frame rate, else nothing."""
    share = uneven_share(path)
    if share <= FEW:
        return []
    return [
        f"the video has a variable frame rate ({100 * share:.0f} % of the gaps between its frames "
        f"are longer or shorter): the clip counts them evenly, at {fps:.4g} a second, and motion "
        "is uneven in it; `ffmpeg -i VIDEO -vf fps=30 even.mp4` makes it even"
    ]
