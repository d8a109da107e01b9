"""Weights of the joint objective's terms, and L_depth (HOIGS Eq. 15, Sec. "Optimization")."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int32, Shaped, UInt8
from torch import Tensor

from hoigs.core.spec.train_schema import LossSpec
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Frame
from hoigs.metrics.ssim import Backend, ssim

PIXELS_FIT = 16_384  # about as many pixels enter medians and fits of depth
FEWEST = 16  # pixels with a prior, below which L_depth says nothing
DepthFit = Literal["auto", "scale", "affine"]

# "supp": supplement, "Objective Function Details"; "main": Eq. 15, a sum without weights
PRESETS = {
    "supp": {"human": 0.5, "object": 1.0, "scene": 0.25, "depth": 1.0},
    "main": {"human": 1.0, "object": 1.0, "scene": 1.0, "depth": 1.0},
}


def term_weights(spec: LossSpec) -> dict[str, float]:
    """Weight of each term: the preset with the overrides of the spec."""
    weights = dict(PRESETS[spec.weights])
    for name in weights:
        override = getattr(spec, name)
        if override is not None:
            weights[name] = override
    return weights


def align_depth(
    depth: Float[Tensor, " P"], prior: Float[Tensor, " P"], kind: str, fit: DepthFit = "auto"
) -> Float[Tensor, " P"]:
    """A depth prior in the units of the render, metres along z.

    Args:
        depth: of the render; fits use it without its gradient, so that only the prior's relative
            depth has an effect.
        kind: of the prior: "metric", metres along z, or "affine-disparity", larger is nearer.
        fit: "auto" takes a metric prior unchanged and fits scale and shift of a relative one in
            disparity (medians first, then reweighted least squares), which scaling by COLMAP points
            could not do. "affine" fits a metric prior too; "scale" multiplies either by one factor,
            the median of the ratios.
    """
    if kind == "metric":
        if fit == "auto":
            return prior
        prior = 1.0 / prior.clamp_min(1e-3)
    inverse = 1.0 / depth.detach().clamp_min(1e-3)
    if fit == "scale":
        ratios = _some(inverse) / _some(prior).clamp_min(1e-9)
        return 1.0 / (prior * ratios.median()).clamp_min(1e-3)
    return _affine_disparity(inverse, prior)


def _affine_disparity(
    inverse: Float[Tensor, " P"], prior: Float[Tensor, " P"]
) -> Float[Tensor, " P"]:
    """Depth from a disparity whose scale and shift are fitted to the render's inverse depth."""
    x, y = _some(prior), _some(inverse)
    center, middle = x.median(), y.median()
    spread = (x - center).abs().median().clamp_min(1e-9)
    slope = (y - middle).abs().median() / spread  # median fit: outliers have no leverage
    shift = middle - center * slope
    columns = torch.stack((x, torch.ones_like(x)), 1)
    for _ in range(5):
        residual = (x * slope + shift - y).abs()
        weights = 1.0 / (1.0 + (residual / (2 * residual.median().clamp_min(1e-6))) ** 2)
        A, b = columns * weights[:, None], (y * weights)[:, None]
        slope, shift = torch.linalg.lstsq(A, b).solution.squeeze(1)
    fit = prior * slope + shift
    return 1.0 / fit.clamp_min(1e-3)


def _some(values: Shaped[Tensor, " P"]) -> Shaped[Tensor, " Q"]:
    """An evenly spaced subset: the median of a million pixels takes tens of milliseconds."""
    return values[:: 1 + len(values) // PIXELS_FIT]


def depth_loss(
    depth: Float[Tensor, "H W"],
    alpha: Float[Tensor, "H W"],
    prior: Float[Tensor, "H W"],
    kind: str,
    fit: DepthFit = "auto",
) -> Float[Tensor, ""] | None:
    """Mean |D_render - D| over the median depth of the prior (HOIGS, Sec. "Human Deformation").

    Over pixels with a prior and an opacity above 0.5; D_render is divided by alpha. With fewer than
    16 such pixels it is 0 for a metric prior that needs no fit, for which nothing waits for the
    device, and None for others, as it is when the clip has no depth.

    Args:
        depth: accumulated depth, metres. prior: 0 where unknown. kind, fit: as for `align_depth`.
    """
    if kind == "none":
        return None
    valid = (prior > 0) & torch.isfinite(prior) & (alpha.detach() > 0.5)
    if kind == "metric" and fit == "auto":
        return _metric_depth_loss(depth, alpha, prior, valid)
    chosen = valid.flatten().nonzero().squeeze(1)
    if len(chosen) < FEWEST:
        return None
    expected, seen, prior = (x.flatten().index_select(0, chosen) for x in (depth, alpha, prior))
    expected = expected / seen.clamp_min(1e-6)
    target = align_depth(expected, prior, kind, fit)
    return (expected - target).abs().mean() / _some(target).median()


def _metric_depth_loss(
    depth: Float[Tensor, "H W"],
    alpha: Float[Tensor, "H W"],
    prior: Float[Tensor, "H W"],
    valid: Bool[Tensor, "H W"],
) -> Float[Tensor, ""]:
    """`depth_loss` by operations whose sizes do not depend on what is valid."""
    count = valid.sum()
    expected = torch.where(valid, depth, 0.0) / torch.where(valid, alpha, 1.0)
    apart = (expected - torch.where(valid, prior, 0.0)).abs().sum() / count.clamp_min(1)
    some, known = _some(prior.flatten()), _some(valid.flatten())
    ordered = torch.where(known, some, torch.inf).sort().values
    middle = ordered.index_select(0, (known.sum()[None] - 1).clamp_min(0) // 2).squeeze(0)
    return torch.where(count < FEWEST, 0.0 * apart, apart / middle)


# Comparison: what a box of a render is compared with, and the image loss between the two.


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
        box: as of `Crop`; `pixels` and masks are whole images then.
    """

    pixels: UInt8[Tensor, "h w 3"]
    shown: Bool[Tensor, "h w"] | None = None
    ignored: Bool[Tensor, "h w"] | None = None
    background: Float[Tensor, "3"] | None = None
    top: int = 0
    left: int = 0
    area: int | None = None
    box: Int32[Tensor, "5"] | None = None

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
    if one.box is not None:
        one = _within_box(one)
        if one.pixels.numel() == 0:
            return 0.0 * render.sum()
    target, own = one.target, one.render_of(render)
    l1 = (own - target).abs().sum() / (3.0 * _area(one))
    if lambda_dssim == 0:
        return l1
    return (1 - lambda_dssim) * l1 + lambda_dssim * (1 - ssim(own, target, backend))


def _within_box(one: Comparison) -> Comparison:
    """The same comparison of slices, which waits for the device of the box."""
    assert one.box is not None
    top, left, height, width, area = one.box.tolist()
    cut = (slice(top, top + height), slice(left, left + width))
    return replace(
        one,
        pixels=one.pixels[cut],
        shown=None if one.shown is None else one.shown[cut],
        ignored=None if one.ignored is None else one.ignored[cut],
        top=top,
        left=left,
        area=None if one.area is None else area,
        box=None,
    )


def _by_kernels(
    render: Float[Tensor, "H W 3"], comparisons: Sequence[Comparison], lambda_dssim: float
) -> Float[Tensor, " terms"]:
    from hoigs.metrics.kernels.image_loss import Target
    from hoigs.metrics.kernels.image_loss import image_losses as by_kernels

    targets = [
        Target(
            one.pixels,
            l1=(1 - lambda_dssim) / (1.0 if one.box is not None else 3.0 * _area(one)),
            dssim=lambda_dssim,
            shown=one.shown,
            ignored=one.ignored,
            background=one.background,
            top=one.top,
            left=one.left,
            box=one.box,
            by_area=one.area is not None,
        )
        for one in comparisons
    ]
    return by_kernels(render, targets)


def _area(one: Comparison) -> int:
    return one.pixels.shape[0] * one.pixels.shape[1] if one.area is None else one.area


# Crops of a frame around one entity, and the masks in them.

MARGIN = 0.15  # of the box, as a share of its size


@dataclass(frozen=True)
class Crop:
    """A box of a frame around an entity; its pixels and its mask are views of the frame's.

    Attributes:
        camera: of the crop. pixels: of the video.
        mask: the entity's visible pixels. area: how many these are.
        ignore: pixels where another entity may hide it, or that show no scene.
        top, left: of the box in the frame, pixels.
        box: top, left, height, width and area, on the device, where a CUDA graph reads them anew at
            each step; everything else is of the whole frame then, and `area` no number. None: the
            crop is what the tensors hold.
    """

    camera: Camera
    pixels: UInt8[Tensor, "h w 3"]
    mask: Bool[Tensor, "h w"]
    ignore: Bool[Tensor, "h w"]
    area: int
    top: int = 0
    left: int = 0
    box: Int32[Tensor, "5"] | None = None

    @property
    def image(self) -> Float[Tensor, "h w 3"]:
        """RGB in [0, 1]."""
        return self.pixels.float() / 255.0

    def cut(self, image: Shaped[Tensor, "H W *C"]) -> Shaped[Tensor, "h w *C"]:
        """The pixels of a whole image that are in the crop."""
        height, width = self.mask.shape
        return image[self.top : self.top + height, self.left : self.left + width]

    def seen_from(self, camera: Camera) -> Camera:
        """The crop's camera where the frame's has another place, as refined ones have."""
        return replace(self.camera, world_to_camera=camera.world_to_camera)


def union(masks: Iterable[Bool[Tensor, "H W"]]) -> Bool[Tensor, "H W"] | None:
    """Pixels that are in any mask; None without masks."""
    total: Tensor | None = None
    for mask in masks:
        total = mask if total is None else total | mask
    return total


def crop_around(frame: Frame, entity: str, on_device: Frame | None = None) -> Crop | None:
    """The box of an entity's mask with a margin relative to its size; None if the mask is empty.

    Args:
        frame: on the CPU, where the box is found. on_device: the same frame on the device of the
            crop, None if that is the CPU.
    """
    flat = frame.masks[entity].cpu().numpy()  # any() is ten times faster than torch's
    rows, columns = np.flatnonzero(flat.any(1)), np.flatnonzero(flat.any(0))
    if len(rows) == 0:
        return None
    source = on_device or frame
    camera = source.camera
    top, bottom = int(rows[0]), int(rows[-1]) + 1
    left, right = int(columns[0]), int(columns[-1]) + 1
    area = int(np.count_nonzero(flat[top:bottom, left:right]))
    pad = max(8, round(MARGIN * max(bottom - top, right - left)))
    top, left = max(0, top - pad), max(0, left - pad)
    bottom, right = min(camera.height, bottom + pad), min(camera.width, right + pad)
    box = (slice(top, bottom), slice(left, right))
    # made of whole masks, so that its lines are as far apart as those of the entity's
    others = union(m for name, m in source.masks.items() if name != entity)
    mask = source.masks[entity]
    ignore = torch.zeros_like(mask) if others is None else others & ~mask
    if source.ignored is not None:
        ignore = ignore | source.ignored
    return Crop(
        camera=camera.cropped(left, top, right - left, bottom - top),
        pixels=source.image[box],
        mask=mask[box],
        ignore=ignore[box],
        area=area,
        top=top,
        left=left,
    )
