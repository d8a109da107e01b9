"""SSIM of images; differentiable, so also a loss.

Images are RGB in [0, 1] with channels last, as `RenderOutput.color` and `Frame.rgb` are. Nothing
here clamps or rounds.

SSIM has two backends of one definition. "torch": convolutions, any floating type, differentiable in
both arguments and twice. "warp": kernels, float32, one gradient, many times faster, for training.
Neither replaces the other unless requested.
"""

from __future__ import annotations

import functools
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.metrics.inputs import check_pair
from hoigs.metrics.kernels.definition import C1, C2, WINDOW, window

Backend = Literal["torch", "warp"]


def ssim(
    image: Float[Tensor, "*batch H W C"],
    target: Float[Tensor, "*batch H W C"],
    backend: Backend = "torch",
) -> Float[Tensor, ""]:
    """Structural similarity: the mean of `ssim_map`; 1 - ssim is the D-SSIM loss.

    Raises:
        ValueError: unequal shapes; with backend="warp" also for input that the
            kernels do not support, such as float64 or a target that requires a gradient.
        RenderError: backend="warp", and Warp is not installed.
    """
    if backend == "torch":
        return ssim_map(image, target).mean()
    if backend != "warp":
        raise ValueError(f'backend is {backend!r}, expected "torch" or "warp"')
    from hoigs.metrics.kernels.ssim import mean_ssim

    check_pair(image, target)
    return mean_ssim(image, target)


def ssim_map(
    image: Float[Tensor, "*batch H W C"], target: Float[Tensor, "*batch H W C"]
) -> Float[Tensor, "*batch H W C"]:
    """SSIM of each pixel and channel (Wang et al. 2004), as 3DGS computes it.

    Window 11x11, Gaussian of sigma 1.5, zero padding, C1 = .01^2, C2 = .03^2, data range 1.
    Differentiable in both arguments.
    """
    check_pair(image, target)
    # SSIM needs only the sum of the two variances, so four blurs suffice instead of five
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

    This is several times faster on a CPU than autograd's general backward of a convolution.
    """

    @staticmethod
    def forward(ctx: Any, planes: Tensor) -> Tensor:
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
        return _Blur.apply(gradients[0])


@functools.lru_cache(maxsize=8)
def _window(dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.tensor(window(), dtype=dtype, device=device).reshape(1, 1, WINDOW, 1)
