"""Read by `mediapipe_script.py`: whether landmarks are those of a person, asked in the mirror.

A network that was trained on people finds a pose in cats, hands and tables, too, but another one
where it sees them mirrored. Of a person it finds the mirrored pose, whose left is the right: off by
2 to 11 % of the torso in the recorded clips of people, by 18 % and more in those of something else.
It imports nothing of hoigs.
"""

from __future__ import annotations

import numpy as np
from mediapipe_guided import HIPS, SHOULDERS, seen_in

SEEN, LEAST = 0.5, 3  # visibility; landmarks that have to be seen both ways
SWAPPED = [0, 4, 5, 6, 1, 2, 3, 8, 7, 10, 9]
SWAPPED += [mark + side for mark in range(11, 33, 2) for side in (1, 0)]
BODY = [0, *range(11, 17), *range(23, 29)]  # nose, shoulders to wrists, hips to ankles
UNLIKE = 0.15  # of the largest of torso, shoulders and thighs: mean distance of the two poses
THIGHS = ((23, 25), (24, 26))
LEGS = 1.5, 1.9  # least lengths of legs, in lengths of the torso and breadths of the shoulders
AROUND = 2.5  # side of a square about the hips, in distances of the farthest landmark
EVERY = 8  # frames of somebody who is followed, of which one is checked


class Check:
    """The pose that the model of landmarks finds in a mirrored picture.

    Args:
        graph, rect: of `landmark_graph`.
    """

    def __init__(self, graph, rect) -> None:
        self.graph, self.rect, self.most = graph, rect, UNLIKE
        self.since = EVERY  # frames since the last check

    def believes(self, off) -> bool:
        """Whether landmarks that are so far off in the mirror are a person's; of the frames between
        checks, always."""
        self.since += 1
        if self.since < EVERY:
            return True
        same = bool(off < UNLIKE)
        self.since = 0 if same else EVERY
        return same

    def seen(self, image, points, space, square=None):
        """How far landmarks are off in the mirror, as `apart` has it, and those in the image and in
        space without what the network makes different of left and right: the mean of those in the
        picture and in the mirrored one, if both show the same pose.

        Args:
            points: x, y in pixels, depth and visibility of the 33 landmarks; space: in metres.
            square: x, y of the middle and side that the landmarks were found in, pixels; None: the
                square about the hips that the model is trained on.
        """
        back = mirrored(self.graph, self.rect, image, points, square)
        off = float("inf") if back is None else apart(points, back[0])
        if back is None or off > UNLIKE:
            return off, points, space
        means = points.copy(), space.copy()
        for mean, other in zip(means, back, strict=True):
            mean[:, :3] = (mean[:, :3] + other[:, :3]) / 2
        return off, *means

    def lose(self) -> None:
        """Nobody is followed: whoever is found next is checked at once."""
        self.since = EVERY


def mirrored(graph, rect, image, points, square=None):
    """Landmarks in the image and in space that the mirrored picture shows, mirrored back; None if
    it shows nobody."""
    width = image.shape[1]
    x, y, side = square or hips_square(points)
    found = seen_in(graph, rect, np.ascontiguousarray(image[:, ::-1]), (width - x, y, side))
    if found is None:
        return None
    other, space = found[0][SWAPPED], found[1][SWAPPED]
    other[:, 0] = width - other[:, 0]
    space[:, 0] *= -1
    return other, space


def difference(graph, rect, image, points, square=None) -> float:
    """Mean distance of the mirrored picture's landmarks from the given ones, as `apart` has it;
    infinite where it shows nobody."""
    found = mirrored(graph, rect, image, points, square)
    return float("inf") if found is None else apart(points, found[0])


def apart(points, other) -> float:
    """Mean distance of two poses' landmarks, in lengths of the torso; infinite where fewer than
    `LEAST` are seen in both."""
    both = (points[BODY, 3] > SEEN) & (other[BODY, 3] > SEEN)
    if both.sum() < LEAST:
        return float("inf")
    torso = points[SHOULDERS, :2].mean(0) - points[HIPS, :2].mean(0)
    lengths = [torso, points[11, :2] - points[12, :2]]
    lengths += [(points[a] - points[b])[:2] for a, b in THIGHS if points[[a, b], 3].min() > SEEN]
    off = np.linalg.norm((points - other)[BODY, :2][both], axis=1).mean()
    return float(off / max(1.0, *(np.linalg.norm(length) for length in lengths)))


def hips_square(points):
    """The square about the middle of the hips that has all landmarks, guessed ones too, and those
    of legs as long as such a trunk has, which are guessed too short behind a table."""
    shoulders, hips = points[SHOULDERS, :2], points[HIPS, :2].mean(0)
    reach = np.linalg.norm(points[:, :2] - hips, axis=1).max()
    trunk = np.linalg.norm(shoulders.mean(0) - hips), np.linalg.norm(shoulders[0] - shoulders[1])
    reach = max(reach, LEGS[0] * trunk[0], LEGS[1] * trunk[1])
    return float(hips[0]), float(hips[1]), float(max(8.0, AROUND * reach))
