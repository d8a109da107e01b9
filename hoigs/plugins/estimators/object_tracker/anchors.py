"""Frames in which an object was found best, from which it is followed again.

What it looks like from other sides is known then, and a mistake ends at the next such frame.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from hoigs.plugins.estimators.object_tracker.pixels.colors import bins_of
from hoigs.plugins.estimators.object_tracker.pixels.footage import Footage
from hoigs.plugins.estimators.object_tracker.prompts import PromptedMask, set_off
from hoigs.plugins.estimators.object_tracker.propagation import Track, window_of

APART = 8  # anchors are at least this part of the video from each other, and from prompts
AROUND = 10  # parts of the video before and after a frame that say how large the object is there
GOOD = 0.6  # of what the best tenth of the frames reach


def anchors(footage: Footage, track: Track, prompts: Sequence[PromptedMask]) -> list[PromptedMask]:
    """Its masks in the best frames of a track, away from the prompted ones."""
    quality = _quality(footage, track)
    least = GOOD * np.quantile(quality, 0.9)
    taken, found = [p.frame for p in prompts], []
    for i in np.argsort(-quality).tolist():
        near = min(abs(i - frame) for frame in taken) < len(footage) / APART
        if quality[i] > least and not near:
            taken.append(i)
            soft = track.soft[i] / np.float32(255)
            found.append(PromptedMask(i, soft, float(quality[i]), False, footage.blank[i]))
    return found


def _quality(footage: Footage, track: Track) -> Float[np.ndarray, " F"]:
    """Of each frame's mask, 0 to 1: how sure it is, how well set off, how usual its size is, and
    how little of it the body may be."""
    masks = track.soft > 127
    area = masks.sum((1, 2)).astype(float)
    seen = np.where(area > 0, area, np.nan)
    reach = max(1, len(masks) // AROUND)
    found = np.zeros(len(masks))
    for i in np.flatnonzero(area).tolist():
        usual = np.nanmedian(seen[max(0, i - reach) : i + reach + 1])
        size = min(area[i], usual) / max(area[i], usual)
        body = (footage.body(i) & masks[i]).sum() / area[i]
        found[i] = track.confidence[i] * _set_off(footage, i, masks[i]) * size**2 * (1 - 0.5 * body)
    return found


def _set_off(footage: Footage, i: int, mask: Bool[np.ndarray, "h w"]) -> float:
    window = window_of(mask)
    colors, valid = window.cut(footage.colors(i)), window.inside(footage.shape)
    return set_off(window.cut(mask) > 0.5, colors, bins_of(colors), valid)
