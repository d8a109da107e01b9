"""Masks of a followed object, outlined again by the network in each frame."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from hoigs.plugins.estimators.object_tracker.footage import Footage
from hoigs.plugins.estimators.object_tracker.outlined import SAME, around, box_of, sharper
from hoigs.plugins.estimators.object_tracker.outlines import HIGH, LOW, Outline, Outlines
from hoigs.plugins.estimators.object_tracker.prompts import overlap
from hoigs.plugins.estimators.object_tracker.propagation import Track

SURE = 0.7  # the network's own estimate from which an outline counts
ROOM = 0.03  # of the longer side of the box about a mask, which may lack a rim


def refined(
    footage: Footage,
    outlines: Outlines,
    track: Track,
    progress: Callable[[float], None] = lambda share: None,
) -> Track:
    """The same object with masks that the network outlines, where it sees one thing in the box
    about a mask that is about this mask; in other frames as it was. All of them as they were, if
    those of the network are less well set off over the video."""
    masks = {int(i): track.soft[i] > 127 for i in np.flatnonzero((track.soft > 127).any((1, 2)))}
    found = {}
    for done, (i, mask) in enumerate(masks.items()):
        better = again(footage, outlines, i, mask)
        if better is not None:
            found[i] = better
        progress((done + 1) / len(masks))
    if not found or not sharper(
        footage, {i: masks[i] for i in found}, {i: soft > 0.5 for i, soft in found.items()}
    ):
        return track
    soft = track.soft.copy()
    for i, better in found.items():
        soft[i] = np.rint(255 * better)
    return Track(soft, track.confidence)


def again(
    footage: Footage, outlines: Outlines, i: int, mask: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w"] | None:
    """A soft mask by the network's outline in the box about a mask; None where it is of something
    else, or not sure."""
    x0, y0, x1, y1 = box_of(mask)
    room = ROOM * max(x1 - x0, y1 - y0)
    outlines.look(footage.numbers[i], around((x0, y0, x1, y1), footage.shape))
    found = outlines.found([(x0 - room, y0 - room), (x1 + room, y1 + room)], [LOW, HIGH])[0]
    kept = _kept(found, mask) & ~footage.blank[i]
    if found.quality < SURE or overlap(kept, mask) < SAME:
        return None
    near = ndimage.binary_dilation(kept, iterations=2)
    return np.where(near, found.soft, np.float32(0))


def _kept(found: Outline, mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The parts of an outline that a mask meets."""
    labels, _ = ndimage.label(found.mask)
    return np.isin(labels, np.setdiff1d(np.unique(labels[mask]), 0))
