"""Crops of a frame around one entity, and the masks in them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Frame


@dataclass(frozen=True)
class Crop:
    """A box of a frame around an entity.

    Attributes:
        camera: of the crop. image: RGB in [0, 1].
        mask: the entity's visible pixels. ignore: pixels where another entity may hide it, or that
            show no scene.
    """

    camera: Camera
    image: Float[Tensor, "h w 3"]
    mask: Bool[Tensor, "h w"]
    ignore: Bool[Tensor, "h w"]


def union(masks: Iterable[Bool[Tensor, "H W"]]) -> Bool[Tensor, "H W"] | None:
    """Pixels that are in any mask; None without masks."""
    total: Tensor | None = None
    for mask in masks:
        total = mask if total is None else total | mask
    return total


def crop_around(
    frame: Frame, camera: Camera, entity: str, on_device: Frame | None = None, margin: float = 0.15
) -> Crop | None:
    """The box of an entity's mask with a margin relative to its size; None if the mask is empty.

    Args:
        frame: on the CPU, where the box is found. on_device: the same frame on the device of the
            crop, None if that is the CPU.
    """
    flat = frame.masks[entity].cpu().numpy()  # any() is ten times faster than torch's
    rows, columns = np.flatnonzero(flat.any(1)), np.flatnonzero(flat.any(0))
    if len(rows) == 0:
        return None
    top, bottom = int(rows[0]), int(rows[-1]) + 1
    left, right = int(columns[0]), int(columns[-1]) + 1
    pad = max(8, round(margin * max(bottom - top, right - left)))
    top, left = max(0, top - pad), max(0, left - pad)
    bottom, right = min(camera.height, bottom + pad), min(camera.width, right + pad)
    box = (slice(top, bottom), slice(left, right))
    source = on_device or frame
    others = union(m[box] for name, m in source.masks.items() if name != entity)
    mask = source.masks[entity][box]
    ignore = torch.zeros_like(mask) if others is None else others & ~mask
    if source.ignored is not None:
        ignore = ignore | source.ignored[box]
    return Crop(
        camera=camera.cropped(left, top, right - left, bottom - top),
        image=source.image[box].float() / 255.0,
        mask=mask,
        ignore=ignore,
    )


def cut(image: Shaped[Tensor, "H W C"], crop: Crop, camera: Camera) -> Shaped[Tensor, "h w C"]:
    """The pixels of a whole image that are in the crop; `camera` is the whole image's."""
    left, top = (camera.K[:2, 2] - crop.camera.K[:2, 2]).round().long().tolist()
    return image[top : top + crop.camera.height, left : left + crop.camera.width]
