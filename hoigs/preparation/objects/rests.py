"""When an object rests, by the middle of its mask."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage

from hoigs.core.values.camera import Camera
from hoigs.preparation.masks.outlines import Outlines

STILL = 0.07  # metres a second: an object that moves less rests
SHORTEST = 0.2  # seconds of a grasp or a rest
STAYS = 0.4  # seconds for which an object with a hand at it has to keep its place to rest


def resting(
    outlines: Outlines,
    depths: Float[np.ndarray, " F"],
    cameras: Sequence[Camera],
    fps: float,
    near: Bool[np.ndarray, " F"],
) -> Bool[np.ndarray, " F"]:
    """Frames in which the mask's middle moves in the image as a point that stands still in the
    world does; with a hand near it only as part of a rest that is certain by its length (`_stays`).

    Args:
        depths: of the object along the view, about, metres. near: frames with a hand at it.
    """
    still = _still(outlines, depths, cameras, fps)
    runs, _ = ndimage.label(still)
    sure = np.unique(runs[_stays(outlines, depths, cameras, fps)])
    still &= ~near | np.isin(runs, sure)
    return cleaned(still[:, None], fps)[:, 0]


def cleaned(flags: Bool[np.ndarray, "F N"], fps: float) -> Bool[np.ndarray, "F N"]:
    """Without runs and gaps shorter than `SHORTEST`."""
    structure = np.ones((max(1, round(SHORTEST * fps)), 1), dtype=bool)
    padded = np.pad(flags, ((len(structure), len(structure)), (0, 0)), mode="edge")
    closed = ndimage.binary_closing(padded, structure)
    opened = ndimage.binary_opening(closed, structure)
    return opened[len(structure) : -len(structure)]


def _still(
    outlines: Outlines,
    depths: Float[np.ndarray, " F"],
    cameras: Sequence[Camera],
    fps: float,
) -> Bool[np.ndarray, " F"]:
    """Frames that have the mask's middle where it was, or will be, a moment apart."""
    count, step = len(cameras), max(1, round(SHORTEST * fps / 2))
    speed = np.full(count, np.inf)
    for i in range(count):
        others = [j for j in (i - step, i + step) if 0 <= j < count]
        rows = [j for j in others if outlines.whole[i] and outlines.whole[j]]
        speed[i] = min(_moved(outlines, depths, cameras, i, rows), default=np.inf) * fps / step
    return speed < STILL


def _stays(
    outlines: Outlines,
    depths: Float[np.ndarray, " F"],
    cameras: Sequence[Camera],
    fps: float,
) -> Bool[np.ndarray, " F"]:
    """Frames of spans of `STAYS` seconds in which the mask's middle keeps to one still point.

    That it is where it was a moment ago may be chance with a hand that moves it: one that moves
    towards the camera, turns back or is only just set in motion.
    """
    count, span = len(cameras), max(3, round(STAYS * fps))
    stays = np.zeros(count, dtype=bool)
    for first in range(count - span + 1):
        rows = list(range(first, first + span))
        if outlines.whole[rows].all():
            moved = _moved(outlines, depths, cameras, rows[span // 2], rows)
            stays[rows] |= max(moved) < STILL * STAYS / 2
    return stays


def _moved(
    outlines: Outlines,
    depths: Float[np.ndarray, " F"],
    cameras: Sequence[Camera],
    start: int,
    rows: Sequence[int],
) -> list[float]:
    """Metres across the view, in some frames, from where the middle of a frame's mask would be had
    it stood still."""
    pixel = torch.tensor(outlines.centers[start], dtype=torch.float32)
    point = cameras[start].unproject(pixel, torch.tensor(float(depths[start])))
    metres = []
    for i in rows:
        xy, depth = cameras[i].project(point[None])
        pixels = float(np.linalg.norm(xy[0].numpy() - outlines.centers[i]))
        metres.append(pixels * float(depth[0]) / float(cameras[i].K[0, 0]))
    return metres
