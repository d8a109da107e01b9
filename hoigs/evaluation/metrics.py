"""PSNR and SSIM, of whole images and of regions; SSIM is fast and differentiable: also a loss.

Images are RGB in [0, 1] with channels last, as `RenderOutput.color` and `Frame.rgb` are. Nothing
here clamps or rounds: whoever scores decides that, and writes it into the protocol.

SSIM has two backends of one definition. "torch": convolutions, any floating type, differentiable in
both arguments and twice. "warp": kernels, float32, one gradient, many times faster; training uses
it at every step. Neither stands in for the other unasked.
"""

from __future__ import annotations

import functools
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hoigs.rasterizers.warp.ssim.definition import C1, C2, WINDOW, window

Backend = Literal["torch", "warp"]
MSE_FLOOR = 1e-10  # two equal images score 100 dB rather than infinity


def psnr(
    image: Float[Tensor, "*batch H W C"], target: Float[Tensor, "*batch H W C"]
) -> Float[Tensor, ""]:
    """Peak signal-to-noise ratio, dB, for a peak of 1.

    Of a batch it is the mean of the PSNR of each image, not the PSNR of the mean error: so do all
    Gaussian code bases (methods D.6). The mean squared error is floored at 1e-10 (100 dB).
    """
    _check_pair(image, target)
    return psnr_from_mse((image - target).square().mean((-3, -2, -1))).mean()


def region_psnr(
    image: Float[Tensor, "H W C"], target: Float[Tensor, "H W C"], region: Bool[Tensor, "H W"]
) -> Float[Tensor, ""]:
    """PSNR over the pixels of a region, dB: the error is divided by the region's area.

    Raises:
        ValueError: the region has no pixels.
    """
    _check_pair(image, target)
    _check_region(image, region)
    return psnr_from_mse((image - target)[region].square().mean())


def psnr_from_mse(mse: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """dB of a mean squared error, for a peak of 1."""
    return -10.0 * mse.clamp_min(MSE_FLOOR).log10()


def ssim(
    image: Float[Tensor, "*batch H W C"],
    target: Float[Tensor, "*batch H W C"],
    backend: Backend = "torch",
) -> Float[Tensor, ""]:
    """Structural similarity: the mean of `ssim_map`; 1 - ssim is the D-SSIM loss.

    Raises:
        ValueError: unequal shapes; with backend="warp" also what `rasterizers.warp.ssim` refuses,
            such as float64 or a target that requires a gradient.
        RenderError: backend="warp", and Warp is not installed.
    """
    if backend == "torch":
        return ssim_map(image, target).mean()
    if backend != "warp":
        raise ValueError(f'backend is {backend!r}, expected "torch" or "warp"')
    from hoigs.rasterizers.warp.ssim import mean_ssim

    _check_pair(image, target)
    return mean_ssim(image, target)


def region_ssim(
    image: Float[Tensor, "H W C"], target: Float[Tensor, "H W C"], region: Bool[Tensor, "H W"]
) -> Float[Tensor, ""]:
    """Mean of the SSIM map over a region's pixels.

    The map is computed on the whole images, so windows at the region's rim see what is outside.

    Raises:
        ValueError: the region has no pixels.
    """
    _check_region(image, region)
    return ssim_map(image, target)[region].mean()


def ssim_map(
    image: Float[Tensor, "*batch H W C"], target: Float[Tensor, "*batch H W C"]
) -> Float[Tensor, "*batch H W C"]:
    """SSIM of each pixel and channel (Wang et al. 2004) as 3DGS computes it (methods D.5).

    Window 11x11, Gaussian of sigma 1.5, zero padding, C1 = .01^2, C2 = .03^2, data range 1.
    Differentiable in both arguments.
    """
    _check_pair(image, target)
    # SSIM needs only the sum of the two variances, so four blurs do instead of the usual five
    planes = torch.stack((image, target, image.square() + target.square(), image * target))
    mean_x, mean_y, square_sum, product = blur(planes.movedim(-1, 1)).movedim(1, -1)
    mean_product = mean_x * mean_y
    mean_square_sum = mean_x.square() + mean_y.square()
    covariance = product - mean_product
    variance_sum = square_sum - mean_square_sum
    return ((2 * mean_product + C1) * (2 * covariance + C2)) / (
        (mean_square_sum + C1) * (variance_sum + C2)
    )


def blur(planes: Float[Tensor, "*batch H W"]) -> Float[Tensor, "*batch H W"]:
    """Gaussian blur of 11x11, sigma 1.5, zero padding, as two one-dimensional convolutions."""
    blurred: Tensor = _Blur.apply(planes.reshape(1, -1, *planes.shape[-2:]))
    return blurred.reshape(planes.shape)


class _Blur(torch.autograd.Function):
    """The window is symmetric and the padding zero, so the blur is its own adjoint.

    Saying so is several times faster on a CPU than autograd's general backward of a convolution.
    """

    @staticmethod
    def forward(ctx: Any, planes: Tensor) -> Tensor:
        del ctx
        # one group a plane: torch's depthwise kernels are ten times faster here than one plane
        # a batch entry
        count, pad, conv = planes.shape[1], WINDOW // 2, torch.nn.functional.conv2d
        column = _window(planes.dtype, planes.device).expand(count, 1, WINDOW, 1)
        return conv(
            conv(planes, column, padding=(pad, 0), groups=count),
            column.mT,
            padding=(0, pad),
            groups=count,
        )

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        del ctx
        blurred: Tensor = _Blur.apply(gradients[0])
        return blurred


@functools.lru_cache(maxsize=8)
def _window(dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.tensor(window(), dtype=dtype, device=device).reshape(1, 1, WINDOW, 1)


def _check_pair(image: Tensor, target: Tensor) -> None:
    if image.shape != target.shape:
        raise ValueError(
            f"image has shape {tuple(image.shape)}, target {tuple(target.shape)}; expected equal "
            "shapes [..., H, W, C]: render at the frame's own camera, or resize the clip"
        )


def _check_region(image: Tensor, region: Tensor) -> None:
    if region.dtype != torch.bool or region.shape != image.shape[:2]:
        raise ValueError(
            f"region is {region.dtype} of shape {tuple(region.shape)}, expected a boolean mask of "
            f"shape {tuple(image.shape[:2])}"
        )
    if not region.any():
        raise ValueError("the region has no pixels, so it has no score")
