"""The part of a frame in which one entity is compared with the video."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from hoigs.core.camera import Camera
from hoigs.core.clip import Frame


@dataclass(frozen=True)
class Crop:
    """A box of a frame around an entity.

    Attributes:
        camera: of the crop alone. image: RGB in [0, 1].
        mask: the entity's visible pixels. ignore: pixels where something else that moves hides
            it, or that show no scene, so that nothing is known of the entity there.
    """

    camera: Camera
    image: Float[Tensor, "h w 3"]
    mask: Bool[Tensor, "h w"]
    ignore: Bool[Tensor, "h w"]


def dilate(mask: Bool[Tensor, "H W"], pixels: int) -> Bool[Tensor, "H W"]:
    """The mask grown by a square of `pixels` to each side."""
    if pixels == 0:
        return mask
    grown = torch.nn.functional.max_pool2d(
        mask[None, None].float(), 2 * pixels + 1, stride=1, padding=pixels
    )
    return grown[0, 0] > 0.5


def union(masks: Iterable[Bool[Tensor, "H W"]]) -> Bool[Tensor, "H W"] | None:
    """All masks together, or None when there are none."""
    total: Tensor | None = None
    for mask in masks:
        total = mask if total is None else total | mask
    return total


def crop_around(
    frame: Frame, camera: Camera, entity: str, there: Frame | None = None, margin: float = 0.15
) -> Crop | None:
    """The box of an entity's mask with a margin of its size; None where it is not seen.

    Args:
        frame: on the host, where the box is found. there: the same on the device of the crop:
            whole frames go over once, and are cut there.
    """
    flat = frame.masks[entity].cpu().numpy()  # whose any() is ten times quicker
    rows, columns = np.flatnonzero(flat.any(1)), np.flatnonzero(flat.any(0))
    if len(rows) == 0:
        return None
    top, bottom = int(rows[0]), int(rows[-1]) + 1
    left, right = int(columns[0]), int(columns[-1]) + 1
    pad = max(8, round(margin * max(bottom - top, right - left)))
    top, left = max(0, top - pad), max(0, left - pad)
    bottom, right = min(camera.height, bottom + pad), min(camera.width, right + pad)
    box = (slice(top, bottom), slice(left, right))
    there = there or frame
    others = union(m[box] for name, m in there.masks.items() if name != entity)
    inside = there.masks[entity][box]
    ignore = torch.zeros_like(inside) if others is None else others & ~inside
    if there.ignored is not None:
        ignore = ignore | there.ignored[box]
    return Crop(
        camera=camera.cropped(left, top, right - left, bottom - top),
        image=there.image[box].float() / 255.0,
        mask=inside,
        ignore=ignore,
    )


def inside(image: Shaped[Tensor, "H W C"], crop: Crop, camera: Camera) -> Shaped[Tensor, "h w C"]:
    """The part of a whole image that a crop of this camera shows."""
    left, top = (camera.K[:2, 2] - crop.camera.K[:2, 2]).round().long().tolist()
    return image[top : top + crop.camera.height, left : left + crop.camera.width]
