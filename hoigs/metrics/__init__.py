"""Metrics and losses of images: RGB in [0, 1], channels last. `hoigs.metrics.psnr(a, b)`.

- `psnr`: peak signal-to-noise ratio. `region_psnr`: over the pixels of a mask.
- `ssim`: structural similarity. `ssim_map`: of each pixel and channel.
- `lpips`: learned perceptual distance, with the weights that are shipped; `Lpips` with others.
- `image_loss`: L1 mixed with 1 - SSIM, the loss of 3D Gaussian Splatting.
- `region_masks`: the regions of a frame that are scored apart.
"""

from __future__ import annotations

from hoigs.metrics.image_loss import image_loss
from hoigs.metrics.lpips import Lpips, lpips
from hoigs.metrics.psnr import psnr, region_psnr
from hoigs.metrics.regions import region_masks
from hoigs.metrics.ssim import ssim, ssim_map

# functions have the names of their modules, which they hide here: import from a module by
# `from hoigs.metrics.psnr import ...`
__all__ = [
    "Lpips", "image_loss", "lpips", "psnr", "region_masks", "region_psnr", "ssim", "ssim_map",
]  # fmt: skip
