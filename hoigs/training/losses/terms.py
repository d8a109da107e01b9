"""Weights of the joint objective's terms, and L_depth (HOIGS Eq. 15, Sec. "Optimization")."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.spec.train_schema import LossSpec

PIXELS_FIT = 16_384  # about as many pixels enter medians and fits of depth
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


def _some(values: Float[Tensor, " P"]) -> Float[Tensor, " Q"]:
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

    Over pixels with a prior and an opacity above 0.5; D_render is divided by alpha. None with fewer
    than 16 such pixels, or when the clip has no depth.

    Args:
        depth: accumulated depth, metres. prior: 0 where unknown. kind, fit: as for `align_depth`.
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
