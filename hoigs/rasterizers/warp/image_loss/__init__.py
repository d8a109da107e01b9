"""L1 and D-SSIM of a render against a video frame, with their gradient, in two CUDA kernels.

    function     image_losses, a differentiable function of torch tensors: the entry
    kernels      the kernels
    source       what they do beside SSIM, as C++

The target is composed from the frame's own bytes, masks and background colour as it is read, so
that neither crops nor composed images are made. `hoigs.training.losses.comparison` has the torch
twin.
"""

from hoigs.rasterizers.warp.image_loss.function import Target, image_losses

__all__ = ["Target", "image_losses"]
