"""Checks of the images and regions that metrics compare."""

from __future__ import annotations

import torch
from torch import Tensor


def check_pair(image: Tensor, target: Tensor) -> None:
    """Raise ValueError unless the shapes are equal."""
    if image.shape != target.shape:
        raise ValueError(
            f"image has shape {tuple(image.shape)}, target {tuple(target.shape)}; expected equal "
            "shapes [..., H, W, C]: render at the frame's own camera, or resize the clip"
        )


def check_region(image: Tensor, region: Tensor) -> None:
    """Raise ValueError unless `region` is a boolean mask of the image with a pixel in it."""
    if region.dtype != torch.bool or region.shape != image.shape[:2]:
        raise ValueError(
            f"region is {region.dtype} of shape {tuple(region.shape)}, expected a boolean mask of "
            f"shape {tuple(image.shape[:2])}"
        )
    if not region.any():
        raise ValueError("the region has no pixels, so it has no score")
