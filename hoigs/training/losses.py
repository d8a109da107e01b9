"""The terms of the joint objective, each a small function (HOIGS, Sec. "Optimization")."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hoigs.core.train_spec import LossSpec
from hoigs.evaluation.metrics import Backend, ssim
from hoigs.training.regions import Crop

PIXELS_FIT = 16_384  # that medians and fits of depth look at, about
DepthFit = Literal["auto", "scale", "affine"]

# Supplement, "Objective Function Details"; the main text sums without weights
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


def image_loss(
    render: Float[Tensor, "H W 3"],
    target: Float[Tensor, "H W 3"],
    lambda_dssim: float,
    backend: Backend = "warp",
) -> Float[Tensor, ""]:
    """(1 - l) L1 + l (1 - SSIM), means over the image (3DGS Eq. 7).

    `backend` is of SSIM, here and below: `LossSpec.ssim`.
    """
    l1 = (render - target).abs().mean()
    if lambda_dssim == 0:
        return l1
    return (1 - lambda_dssim) * l1 + lambda_dssim * (1 - ssim(render, target, backend))


def masked_loss(
    render: Float[Tensor, "h w 3"],
    crop: Crop,
    background: Float[Tensor, "3"],
    lambda_dssim: float,
    backend: Backend = "warp",
) -> Float[Tensor, ""]:
    """An entity drawn alone over `background` against the video composed over the same colour.

    Composing the target, rather than multiplying an SSIM map by a hard-edged mask, teaches the
    silhouette too: what sticks out shows against a colour that is new at every step. L1 is
    normalised by the mask's area; hidden pixels count for nothing (methods A.8).
    """
    target = torch.where(crop.mask[..., None], crop.image, background)
    render = torch.where(crop.ignore[..., None], target, render)
    l1 = (render - target).abs().sum() / (3.0 * crop.mask.sum())
    if lambda_dssim == 0:
        return l1
    return (1 - lambda_dssim) * l1 + lambda_dssim * (1 - ssim(render, target, backend))


def scene_only_loss(
    render: Float[Tensor, "H W 3"],
    target: Float[Tensor, "H W 3"],
    dynamic: Bool[Tensor, "H W"] | None,
    lambda_dssim: float,
    backend: Backend = "warp",
) -> Float[Tensor, ""]:
    """The static scene alone, with the pixels of everything that moves left out."""
    if dynamic is not None:
        render = torch.where(dynamic[..., None], target, render)
    return image_loss(render, target, lambda_dssim, backend)


def align_depth(
    depth: Float[Tensor, " P"], prior: Float[Tensor, " P"], kind: str, fit: DepthFit = "auto"
) -> Float[Tensor, " P"]:
    """A prior brought to the units of the render, robustly.

    "auto" takes a metric prior as it stands and fits scale and shift in disparity to a relative
    one (medians first, then reweighted least squares), which scaling by COLMAP points could not
    do. "affine" does so to a metric prior too; "scale" multiplies either by one factor, the median
    of the ratios. What is fitted is told the render's own depth, so that only its shape teaches.

    Args:
        kind: "metric", metres along z, or "affine-disparity", larger is nearer.
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
    """Depth from a disparity whose scale and shift are fitted to the render's, robustly."""
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


def _some(values: Float[Tensor, " P"]) -> Float[Tensor, " Q"]:
    """Evenly spaced ones, for a median: that of a million pixels takes tens of milliseconds."""
    return values[:: 1 + len(values) // PIXELS_FIT]


def depth_loss(
    depth: Float[Tensor, "H W"],
    alpha: Float[Tensor, "H W"],
    prior: Float[Tensor, "H W"],
    kind: str,
    fit: DepthFit = "auto",
) -> Float[Tensor, ""] | None:
    """|D_render - D|_1 of the composite, alpha-normalised, over the scene's median depth.

    Pixels count where the prior is known and the render is more than half opaque. None when
    fewer than 16 do, or when the clip has no depth.
    """
    if kind == "none":
        return None
    valid = (prior > 0) & torch.isfinite(prior) & (alpha.detach() > 0.5)
    chosen = valid.flatten().nonzero().squeeze(1)
    if len(chosen) < 16:
        return None
    expected, seen, prior = (x.flatten().index_select(0, chosen) for x in (depth, alpha, prior))
    expected = expected / seen.clamp_min(1e-6)
    target = align_depth(expected, prior, kind, fit)
    return (expected - target).abs().mean() / _some(target).median()
