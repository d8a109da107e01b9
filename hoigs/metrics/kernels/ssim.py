"""SSIM by Warp kernels as a differentiable function of torch tensors."""

from __future__ import annotations

import functools
import warnings
from typing import Any, Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.errors import RenderError
from hoigs.core.first_order import first_order

INT32 = 2**31 - 1
OTHERWISE = 'use backend="torch" (train.loss.ssim: torch)'


class Kernels(Protocol):
    """Computes the SSIM of contiguous images [B, H, W, C] on a device."""

    max_channels: int | None

    def mean(
        self, image: Tensor, target: Tensor, with_gradient: bool
    ) -> tuple[Tensor, tuple[Tensor, ...]]:
        """The mean, and the tensors that `gradient` needs."""

    def gradient(self, kept: tuple[Tensor, ...], upstream: Tensor) -> Tensor:
        """Gradient of upstream * mean by the image."""

    def map(self, image: Tensor, target: Tensor) -> Tensor:
        """SSIM of each pixel and channel."""


def mean_ssim(
    image: Float[Tensor, "*batch H W C"], target: Float[Tensor, "*batch H W C"]
) -> Float[Tensor, ""]:
    """Mean SSIM (Wang et al. 2004) of float32 images in [0, 1].

    Window 11x11, Gaussian of sigma 1.5, zero padding. Two runs agree bit for bit, whatever the
    number of cores. Differentiable once, and in `image` only. Where the CPU kernel does not
    compile, the slower ones of CUDA are used as scalar code, with a warning.

    Raises:
        ValueError: unequal shapes, no pixels, no float32, a device without kernels, or a target
            that requires a gradient.
        RenderError: Warp is not installed.
    """
    _check(image, target)
    kernels = _kernels(image.device.type)
    tracked = torch.is_grad_enabled() and image.requires_grad
    return _Mean.apply(_planes(image, kernels), _planes(target, kernels), kernels, tracked)


def ssim_map(
    image: Float[Tensor, "*batch H W C"], target: Float[Tensor, "*batch H W C"]
) -> Float[Tensor, "*batch H W C"]:
    """SSIM of each pixel and channel, as in `mean_ssim` but not differentiable.

    Raises:
        ValueError: as in `mean_ssim`; also when the image requires a gradient.
        RenderError: Warp is not installed.
    """
    _check(image, target)
    if torch.is_grad_enabled() and image.requires_grad:
        raise ValueError(
            "the Warp kernels differentiate the mean of SSIM, not its map: draw the map under "
            f"torch.no_grad(), or {OTHERWISE}"
        )
    kernels = _kernels(image.device.type)
    planes = _planes(image, kernels)
    with torch.cuda.device_of(image):
        result = kernels.map(planes, _planes(target, kernels))
    if planes.shape[-1] == image.shape[-1]:
        return result.reshape(image.shape)
    return result.reshape(image.movedim(-1, -3).shape).movedim(-3, -1)


class _Mean(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, kernels: Kernels, tracked: bool) -> Tensor:
        with torch.cuda.device_of(image):
            value, kept = kernels.mean(image, target, tracked)
        ctx.kernels = kernels
        ctx.save_for_backward(*kept)
        return value

    @staticmethod
    @first_order("SSIM by Warp kernels", f"for those {OTHERWISE}")
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        with torch.cuda.device_of(upstream[0]):
            return ctx.kernels.gradient(ctx.saved_tensors, upstream[0]), None, None, None


@functools.cache
def _kernels(device: str) -> Kernels:
    try:
        import warp  # noqa: F401
    except ImportError as error:
        raise RenderError(
            f"SSIM by kernels needs Warp, which is not installed: pip install warp-lang, or "
            f"{OTHERWISE}"
        ) from error
    if device == "cuda":
        from hoigs.metrics.kernels.tiles import TileKernels

        return TileKernels()
    return _cpu_kernels()


def _cpu_kernels() -> Kernels:
    """The CPU kernel where it compiles; else those of CUDA as scalar code, and a warning."""
    from hoigs.metrics.kernels.strips import StripKernels

    kernels, trial = StripKernels(), torch.ones(1, 1, 1, 1)
    try:
        kernels.map(trial, trial)
    except Exception as error:  # Warp raises nothing narrower when a build fails
        from hoigs.metrics.kernels.tiles import TileKernels

        warnings.warn(
            f"the CPU kernel of SSIM does not run here: {error}; slower scalar kernels are used "
            f"instead; or {OTHERWISE}",
            stacklevel=2,
        )
        return TileKernels()
    return kernels


def _planes(images: Tensor, kernels: Kernels) -> Tensor:
    """[B, H, W, C], contiguous; with more channels than the kernels take, [B C, H, W, 1]."""
    channels = images.shape[-1]
    if kernels.max_channels is not None and channels > kernels.max_channels:
        images, channels = images.movedim(-1, -3).unsqueeze(-1), 1
    return images.reshape(-1, *images.shape[-3:-1], channels).contiguous()


def _check(image: Tensor, target: Tensor) -> None:
    if image.shape != target.shape or image.dim() < 3 or image.numel() == 0:
        raise ValueError(
            f"image has shape {tuple(image.shape)}, target {tuple(target.shape)}; expected equal "
            "shapes [..., H, W, C] with at least one pixel"
        )
    if image.dtype != torch.float32 or target.dtype != torch.float32:
        raise ValueError(
            f"image is {image.dtype}, target {target.dtype}; the Warp kernels of SSIM expect "
            f"torch.float32: {OTHERWISE}"
        )
    if image.device != target.device or image.device.type not in ("cpu", "cuda"):
        raise ValueError(
            f"image is on {image.device}, target on {target.device}; the Warp kernels of SSIM "
            f"expect both on the CPU or on one CUDA device: move one, or {OTHERWISE}"
        )
    if torch.is_grad_enabled() and target.requires_grad:
        raise ValueError(
            "the target requires a gradient, and the Warp kernels differentiate SSIM in the image "
            f"only: pass target.detach(), swap the two (SSIM is symmetric), or {OTHERWISE}"
        )
    if image.numel() > INT32:
        raise ValueError(
            f"the images hold {image.numel()} numbers, more than {INT32}, the most that the Warp "
            "kernels of SSIM can address: score fewer at a time"
        )
