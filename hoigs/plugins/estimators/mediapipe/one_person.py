"""Whether MediaPipe's own way from frame to frame stayed with one person.

Its detector takes whom it likes, and where several people are seen its landmarks leap from one to
another. People do not: from frame to frame their place and size change little.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

TORSO = [11, 12, 23, 24]  # of the 33 landmarks: shoulders and hips
LEAP, GROWTH = 0.4, 1.6  # in sizes, and times: what moves, grows or shrinks more is someone else
A_FRAME = (0.02, 0.01)  # by which these grow with each frame in which nobody is seen
MOST = (1.0, 2.0)  # up to which
FEWEST = 5  # frames in a row of someone else: fewer are a pose that was mistaken


@dataclass
class _Way:
    """One person's frames, and where they were last: the torso's middle and the size, pixels."""

    frames: list[int]
    middle: Float[np.ndarray, "2"]
    size: float

    def leads_to(self, i: int, middle: Float[np.ndarray, "2"], size: float) -> bool:
        gap = i - self.frames[-1] - 1
        leap, growth = (
            min(first + gap * more, most)
            for first, more, most in zip((LEAP, GROWTH), A_FRAME, MOST, strict=True)
        )
        moved = float(np.linalg.norm(middle - self.middle)) / max(size, self.size)
        return moved < leap and 1 / growth < size / self.size < growth


def someone_else(image: Float[np.ndarray, "N 33 4"]) -> Bool[np.ndarray, " N"]:
    """The frames whose landmarks are of another person than most frames' are.

    Args:
        image: landmarks in consecutive frames, pixels; NaN where nobody is seen.
    """
    ways: list[_Way] = []
    for i in np.flatnonzero(np.isfinite(image[:, 0, 0])).tolist():
        points = image[i, :, :2]
        middle, size = points[TORSO].mean(0), max(1.0, float(np.ptp(points, axis=0).max()))
        near = [way for way in ways if way.leads_to(i, middle, size)]
        if near:  # the one who was seen last
            way = max(near, key=lambda w: w.frames[-1])
            way.frames.append(i)
            way.middle, way.size = middle, size
        else:
            ways.append(_Way([i], middle, size))
    other = np.zeros(len(image), bool)
    for way in sorted(ways, key=lambda w: -len(w.frames))[1:]:
        breaks = np.flatnonzero(np.diff(way.frames) > 1) + 1
        in_a_row = max(len(part) for part in np.split(np.array(way.frames), breaks))
        other[way.frames] = in_a_row >= FEWEST
    return other
