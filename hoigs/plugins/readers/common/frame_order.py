"""The order of frames, and when each was taken."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from hoigs.core.values.clip import BodyTrack
from hoigs.core.values.moment import Moment

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")


def natural(name: str) -> list[tuple[int, int, str]]:
    """A sort key with which frame_9 comes before frame_10."""
    parts = re.split(r"(\d+)", name)
    return [(0, int(p), "") if p.isdigit() else (1, 0, p) for p in parts if p]


def image_files(folder: Path) -> list[Path]:
    """The images of a folder, in natural order of their names."""
    if not folder.is_dir():
        return []
    found = [p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file()]
    return sorted(found, key=lambda p: natural(p.name))


def video_moments(
    indices: Sequence[int], count: int, bodies: Mapping[str, BodyTrack] | None = None
) -> list[Moment]:
    """Moments of a video's frames, evenly spaced in time.

    Args:
        indices: frame numbers among the video's, which may leave some out.
        count: frames of the whole video, so that frames that were left out still take their time.
        bodies: tracks with one pose for each of `indices`.
    """
    last = max(count - 1, 1)
    return [
        Moment(index / last, index, {n: t.poses.frame(i) for n, t in (bodies or {}).items()})
        for i, index in enumerate(indices)
    ]


def timed_moments(times: Sequence[float], train: Sequence[int]) -> list[Moment]:
    """Moments at given times, numbered on the even grid that the training times span.

    Args:
        times: of all frames, in any unit from 0; scaled to [0, 1] by the largest if it exceeds 1
            (4DGaussians, scene/dataset_readers.py: read_timeline).
        train: positions of the training frames; their different times are the clip's frames.
    """
    longest = max(times)
    scaled = [t / longest if longest > 1 else t for t in times]
    steps = max(len({scaled[i] for i in train}) - 1, 1)
    return [Moment(t, round(t * steps)) for t in scaled]
