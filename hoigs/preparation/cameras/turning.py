"""Whether a camera only turns on its spot: one rotation explains where all features went.

The picture of a camera that turns by R goes over into another by the homography K R K^-1, whatever
the depth (Hartley and Zisserman 2004, 8.4); one that also moves shows near things shift against far
ones.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

FOCALS = np.geomspace(0.5, 2.5, 12)  # tried, in longer sides of the image
NEAR = 1.5  # pixels from where a rotation would put a feature
SHARE = 0.8  # of the features that have to be as near
STEPS = 6  # of reweighting

Pair = tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, "N 2"]]


def turn_share(pairs: Sequence[Pair], size: tuple[int, int]) -> tuple[float, float]:
    """How well turns explain pairs of images, and the largest of these turns.

    Args:
        pairs: positions of the same features in two images, pixels. size: of the images.

    Returns:
        the smallest, over pairs, share of features that lie within `NEAR` pixels of where the best
        turn puts them, for the focal length with the largest such share; and degrees.
    """
    best = (0.0, 0.0)
    for focal in FOCALS * max(size):
        found = [best_turn(pair, float(focal), size) for pair in pairs]
        share = min(share for share, _ in found)
        if share > best[0]:
            best = share, max(degrees(R) for _, R in found)
    return best


def best_turn(
    pair: Pair, focal: float, size: tuple[int, int]
) -> tuple[float, Float[np.ndarray, "3 3"]]:
    """The share of features that the best rotation explains, and that rotation."""
    one, two = (_rays(xy, focal, size) for xy in pair)
    weights = np.ones(len(one))
    for _ in range(STEPS):
        R = nearest_rotation((two * weights[:, None]).T @ one)
        moved = one @ R.T
        seen = moved[:, :2] / moved[:, 2:] * focal + np.array(size) / 2
        off = np.linalg.norm(seen - pair[1], axis=-1)
        weights = 1 / (1 + (off / NEAR) ** 2)
    return float((off < NEAR).mean()), R


def nearest_rotation(matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation with the least sum of squared differences (Kabsch 1976)."""
    u, _, v = np.linalg.svd(matrix)
    turn: np.ndarray = u @ np.diag((1, 1, np.sign(np.linalg.det(u @ v)))) @ v
    return turn


def degrees(R: Float[np.ndarray, "3 3"]) -> float:
    """The angle of a rotation."""
    return float(np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1))))


def _rays(
    xy: Float[np.ndarray, "N 2"], focal: float, size: tuple[int, int]
) -> Float[np.ndarray, "N 3"]:
    rays = np.concatenate(((xy - np.array(size) / 2) / focal, np.ones((len(xy), 1))), -1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)
