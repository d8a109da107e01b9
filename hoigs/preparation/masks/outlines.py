"""Measures of a mask's outline: middle, length and direction of its long axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from hoigs.core.maths.series import fill_gaps
from hoigs.preparation.masks.mask_stack import MaskStack
from hoigs.preparation.video.source import SourceError

SMALL = 0.25  # of the median area: a segmenter that lost the object leaves such crumbs
ELONGATED = 1.2  # length over breadth from which a long axis has a direction


@dataclass(frozen=True)
class Outlines:
    """Measures of a mask over the frames.

    Attributes:
        centers: centroids, pixels, interpolated where not observed.
        lengths: of the long axis (four standard deviations), pixels; NaN where not whole.
        angles: direction of the long axis, radians in (-pi/2, pi/2], image axes; NaN where not
            whole, or as broad as long.
        areas: pixels. observed: not empty, nor a crumb. whole: observed, and not cut by the
            image's border.
    """

    centers: Float[np.ndarray, "F 2"]
    lengths: Float[np.ndarray, " F"]
    angles: Float[np.ndarray, " F"]
    areas: Float[np.ndarray, " F"]
    observed: Bool[np.ndarray, " F"]
    whole: Bool[np.ndarray, " F"]


def outlines_of(masks: MaskStack) -> Outlines:
    """Measures of every mask.

    Raises:
        SourceError: all masks are empty.
    """
    areas = np.array([float(m.sum()) for m in masks])
    if not areas.any():
        raise SourceError("the object's mask is empty in every frame: there is nothing to track")
    observed = areas >= SMALL * np.median(areas[areas > 0])
    count = len(masks)
    centers, lengths, angles = np.zeros((count, 2)), np.full(count, np.nan), np.full(count, np.nan)
    whole = np.zeros(count, dtype=bool)
    for i in np.flatnonzero(observed).tolist():
        mask = masks[i]
        xy = np.argwhere(mask)[:, ::-1] + 0.5
        centers[i] = xy.mean(0)
        whole[i] = not cut_off(mask)
        if whole[i]:
            lengths[i], angles[i] = long_axis(xy)
    filled = fill_gaps(centers, observed)
    return Outlines(filled, lengths, angles, areas, observed, whole)


def long_axis(xy: Float[np.ndarray, "N 2"]) -> tuple[float, float]:
    """Length (four standard deviations) and direction of some pixels' long axis; the direction is
    NaN if they are about as broad as long."""
    offset = xy - xy.mean(0)
    variances, axes = np.linalg.eigh(offset.T @ offset / len(xy))
    length = 4 * float(np.sqrt(variances[1]))
    if variances[1] < ELONGATED**2 * variances[0]:
        return length, float("nan")
    x, y = axes[:, 1]
    return length, float(np.arctan2(y, x) if x > 0 or (x == 0 and y > 0) else np.arctan2(-y, -x))


def cut_off(mask: Bool[np.ndarray, "H W"]) -> bool:
    """Whether the mask touches the image's border."""
    return bool(mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any())
