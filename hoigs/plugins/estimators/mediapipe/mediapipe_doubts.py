"""Read by `mediapipe_script.py` and by the estimator: whether landmarks are a person's, and what
became of a frame.

Landmarks are held against the mask that the model of poses gives with them. The segmentation of the
whole frame, by a model of selfies, often lacks a head or an arm and takes furniture in: it only
tells that something small was taken for a person. It imports nothing of hoigs.
"""

from __future__ import annotations

import numpy as np

SEEN = 0.5  # visibility
LEAST = 4  # landmarks that have to be seen within the picture
CREDIBLE = 0.5  # share of the seen landmarks that have to lie on the mask
TALL, PART = 0.3, 0.35  # of the height and of the area of the mask of people: landmarks that span
# less, with a mask that covers less, are of something else, such as a mug

FOUND, BORDER, SQUARE, NOBODY, FEW, OFF, SMALL, UNSURE, GONE, UNLIKE, NARROW, TURNED = range(12)
# in words, of frames whose person was found at a further look, and of those in which they were not
REPAIRED = {
    BORDER: "found with a border above the picture",
    SQUARE: "found without the detector, which looks for a face",
}
LOST = {
    NOBODY: "nobody was found",
    FEW: f"fewer than {LEAST} landmarks were seen within the picture",
    OFF: "most landmarks were not on the mask of their own person",
    SMALL: "something much smaller than the people in the picture was taken for a person",
    UNSURE: "shoulders and arms were hardly seen",
    GONE: "the person was out of sight, or not told apart from others",
    UNLIKE: "another pose was seen in the mirrored picture: it is hardly a person",
    NARROW: "the shoulders that were seen were much narrower than the person's",
    TURNED: "the shoulders were not seen above the hips",
}


def doubt(points, own, wide) -> int:
    """Why landmarks are not believed, a key of LOST; FOUND if they are.

    Args:
        points: x, y in pixels, depth and visibility of the 33 landmarks.
        own: the mask that came with them. wide: mask of all people. 0..1 a pixel; None: not known.
    """
    seen = inside(points, own)
    if seen is None:
        return FOUND
    if len(seen) < LEAST:
        return FEW
    if share_on(points, own) < CREDIBLE:
        return OFF
    if wide is None or not (wide > 0.5).any():
        return FOUND
    rows = np.flatnonzero((wide > 0.5).any(1))
    low = np.ptp(seen[:, 1]) < TALL * (rows[-1] - rows[0])
    return SMALL if low and (own > 0.5).sum() < PART * (wide > 0.5).sum() else FOUND


def share_on(points, mask) -> float:
    """Share of the visible landmarks on a mask; 1 without one, or if it is empty."""
    seen = inside(points, mask)
    if seen is None or not len(seen) or not (mask > 0.5).any():
        return 1.0
    x, y = seen.astype(int).T
    return float((mask[y, x] > 0.5).mean())


def inside(points, mask):
    """Places of the landmarks that are seen within the picture; None without a mask."""
    if mask is None:
        return None
    seen = points[points[:, 3] > SEEN, :2]
    height, width = mask.shape
    return seen[(seen >= 0).all(1) & (seen[:, 0] < width) & (seen[:, 1] < height)]
