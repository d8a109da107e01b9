"""Metrics of images, used by losses and by evaluation.

- `psnr.psnr`: peak signal-to-noise ratio.
- `ssim.ssim`: structural similarity. `image_loss.image_loss`: L1 mixed with 1 - SSIM.
- `lpips.Lpips`: learned perceptual distance, with weights from a file of the user.
- `regions.region_masks`: the regions of a frame that are scored apart.
"""
