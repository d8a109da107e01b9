"""Comparison: what a box of a render is compared with, and the image loss between the two."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from hoigs.metrics.ssim import Backend, ssim


@dataclass(frozen=True)
class Comparison:
    """The target of one image term (HOIGS Eq. 16 to 18), on the device of the render.

    The target is the frame's pixels where `shown`, elsewhere one colour. Composing it over that
    colour, rather than multiplying an SSIM map by a hard-edged mask, trains the silhouette of an
    entity drawn alone too: Gaussians outside its mask differ from a colour that is new at every
    step.

    Attributes:
        pixels: of the frame. shown: None where all are. ignored: pixels that have no loss, or None.
        background: RGB in [0, 1]; needed where `shown` is not None.
        top, left: of the box in the render, pixels.
        area: L1 is the sum of absolute differences over three times this many pixels; None for
            those of the box, which makes it a mean.
    """

    pixels: UInt8[Tensor, "h w 3"]
    shown: Bool[Tensor, "h w"] | None = None
    ignored: Bool[Tensor, "h w"] | None = None
    background: Float[Tensor, "3"] | None = None
    top: int = 0
    left: int = 0
    area: int | None = None

    @property
    def target(self) -> Float[Tensor, "h w 3"]:
        """What the render should look like, RGB in [0, 1]."""
        image = self.pixels.float() / 255.0
        if self.shown is None or self.background is None:
            return image
        return torch.where(self.shown[..., None], image, self.background)

    def render_of(self, render: Float[Tensor, "H W 3"]) -> Float[Tensor, "h w 3"]:
        """The box of a render, with the target where pixels are ignored."""
        height, width = self.pixels.shape[:2]
        box = render[self.top : self.top + height, self.left : self.left + width]
        return (
            box if self.ignored is None else torch.where(self.ignored[..., None], self.target, box)
        )


def image_losses(
    render: Float[Tensor, "H W 3"],
    comparisons: Sequence[Comparison],
    lambda_dssim: float,
    backend: Backend,
) -> list[Float[Tensor, ""]]:
    """(1 - lambda) L1 + lambda (1 - SSIM) of a render against each target.

    Args:
        backend: of SSIM (`LossSpec.ssim`). With "warp" on CUDA, two kernels compute the whole loss.
    """
    if backend == "warp" and render.is_cuda:
        return list(_by_kernels(render, comparisons, lambda_dssim).unbind())
    return [_by_torch(render, one, lambda_dssim, backend) for one in comparisons]


def _by_torch(
    render: Float[Tensor, "H W 3"], one: Comparison, lambda_dssim: float, backend: Backend
) -> Float[Tensor, ""]:
    target, own = one.target, one.render_of(render)
    l1 = (own - target).abs().sum() / (3.0 * _area(one))
    if lambda_dssim == 0:
        return l1
    return (1 - lambda_dssim) * l1 + lambda_dssim * (1 - ssim(own, target, backend))


def _by_kernels(
    render: Float[Tensor, "H W 3"], comparisons: Sequence[Comparison], lambda_dssim: float
) -> Float[Tensor, " terms"]:
    from hoigs.rasterizers.warp.image_loss import Target
    from hoigs.rasterizers.warp.image_loss import image_losses as by_kernels

    targets = [
        Target(
            one.pixels,
            l1=(1 - lambda_dssim) / (3.0 * _area(one)),
            dssim=lambda_dssim,
            shown=one.shown,
            ignored=one.ignored,
            background=one.background,
            top=one.top,
            left=one.left,
        )
        for one in comparisons
    ]
    return by_kernels(render, targets)


def _area(one: Comparison) -> int:
    return one.pixels.shape[0] * one.pixels.shape[1] if one.area is None else one.area
