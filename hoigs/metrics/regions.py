"""Regions of a frame that are scored apart, from its masks by entity."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Bool
from torch import Tensor

from hoigs.core.values.clip import Frame
from hoigs.core.values.tokens import EntityKind

REGIONS = ("full", "human_object", "human", "object", "interaction", "background")

MEANING = {
    "full": "every pixel that shows the scene",
    "human_object": "visible pixels of any human or object",
    "human": "visible pixels of any human",
    "object": "visible pixels of any object",
    "interaction": "pixels near both a human and an object",
    "background": "pixels of no human and no object",
}


def region_masks(
    frame: Frame, kinds: Mapping[str, EntityKind], band: int
) -> dict[str, Bool[Tensor, "H W"]]:
    """The mask of each of REGIONS; all False where a frame has none of it.

    No region holds pixels that show no scene (`Frame.ignored`). Where the mask of an entity is not
    known, no region that it decides holds any.

    Args:
        kinds: kind of each entity of the clip.
        band: the interaction band holds the pixels within `band` pixels (to each side) of a
            human's mask and also within `band` pixels of an object's.
    """
    empty = torch.zeros(frame.image.shape[:2], dtype=torch.bool)
    human, object_ = empty.clone(), empty.clone()
    for name, mask in frame.masks.items():
        if kinds[name] == "human":
            human |= mask
        elif kinds[name] == "object":
            object_ |= mask
    either = human | object_
    regions = {
        "full": torch.ones_like(empty),
        "human_object": either,
        "human": human,
        "object": object_,
        "interaction": dilate(human, band) & dilate(object_, band),
        "background": ~either,
    }
    unknown = {kinds[name] for name in frame.unknown}
    if unknown:
        decided = {"human_object", "interaction", "background", *unknown}
        regions |= dict.fromkeys(decided & set(regions), empty)
    if frame.ignored is None:
        return regions
    return {name: mask & ~frame.ignored for name, mask in regions.items()}


def default_band(width: int, height: int) -> int:
    """Pixels of the interaction band: 2 % of the longer side, at least 2."""
    return max(2, round(0.02 * max(width, height)))


def dilate(mask: Bool[Tensor, "H W"], pixels: int) -> Bool[Tensor, "H W"]:
    """The mask grown by `pixels` to each side (a square: Chebyshev distance)."""
    if pixels == 0:
        return mask
    side = 2 * pixels + 1
    pool = torch.nn.functional.max_pool2d
    grown = mask[None, None].float()
    grown = pool(grown, (side, 1), stride=1, padding=(pixels, 0))
    return pool(grown, (1, side), stride=1, padding=(0, pixels))[0, 0] > 0.5
