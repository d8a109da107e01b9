"""Cubic Hermite splines over uniform keyframes (HOIGS, Sec. "Spline-based Motion Modeling").

Knots are uniform over the clip's time [0, 1]: keyframe k stands at k / (K - 1), in general between
two frames. Tangents are displacements per keyframe interval. Every function gathers only the
knots that it needs, never all K of them.
"""

from __future__ import annotations

import math
from typing import Any, overload

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.clock import Time, constant


def keyframe_count(num_frames: int, step: int) -> int:
    """K = max(2, round((N_f - 1) / step) + 1): the count nearest to one keyframe every `step`
    frames (the paper's interval is 4; N_f - 1 is rarely a multiple of it)."""
    if num_frames < 1 or step < 1:
        raise ValueError(
            f"keyframe_count needs at least one frame and a step of 1, got {num_frames}, {step}"
        )
    return max(2, math.floor((num_frames - 1) / step + 0.5) + 1)


@overload
def keyframe_position(time: float, keyframes: int) -> tuple[int, float]: ...


@overload
def keyframe_position(time: Tensor, keyframes: int) -> tuple[Tensor, Tensor]: ...


def keyframe_position(time: Any, keyframes: int) -> tuple[Any, Any]:
    """First knot k and position r in [0, 1] of `time` within the interval [k, k + 1].

    t_s = t_n (K - 1), as in the paper, but k = min(floor(t_s), K - 2): its formula asks for the
    missing knot K at the last frame. Times outside [0, 1] are held at the ends.
    """
    if keyframes < 2:
        raise ValueError(f"a spline needs at least 2 keyframes, got {keyframes}")
    if isinstance(time, Tensor):
        place = time.clamp(0.0, 1.0) * (keyframes - 1)
        below = place.floor().clamp_max(keyframes - 2)
        return below.long(), place - below
    scaled = min(max(time, 0.0), 1.0) * (keyframes - 1)
    k = min(math.floor(scaled), keyframes - 2)
    return k, scaled - k


def knot_pair(values: Float[Tensor, "N K ..."], k: Any) -> tuple[Tensor, Tensor]:
    """Values at knots k and k + 1, where k is a number or a 0-d tensor."""
    if isinstance(k, Tensor):
        return values.index_select(1, k).squeeze(1), values.index_select(1, k + 1).squeeze(1)
    return values[:, k], values[:, k + 1]


# `hermite_basis` and its derivative in powers 1, r, r^2, r^3: a column for each of the four weights
HERMITE = (
    (1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (-3.0, -2.0, 3.0, -1.0), (2.0, 1.0, -2.0, 1.0)
)  # fmt: skip
HERMITE_RATES = (
    (0.0, 1.0, 0.0, 0.0), (-6.0, -4.0, 6.0, -2.0), (6.0, 3.0, -6.0, 3.0), (0.0, 0.0, 0.0, 0.0)
)  # fmt: skip


def hermite_basis(r: Any) -> tuple[Any, Any, Any, Any]:
    """Weights of m_k, tau_k, m_{k+1}, tau_{k+1} at r in [0, 1] (HOIGS, equation of CHS)."""
    return (
        2 * r**3 - 3 * r**2 + 1,
        r**3 - 2 * r**2 + r,
        -2 * r**3 + 3 * r**2,
        r**3 - r**2,
    )


def hermite_basis_derivative(r: Any) -> tuple[Any, Any, Any, Any]:
    """Derivative of `hermite_basis` in r: per keyframe interval."""
    return 6 * r**2 - 6 * r, 3 * r**2 - 4 * r + 1, -6 * r**2 + 6 * r, 3 * r**2 - 2 * r


def cubic_hermite(
    values: Float[Tensor, "N K D"],
    tangents: Float[Tensor, "N K D"],
    time: Time,
    *,
    derivative: bool = False,
) -> Float[Tensor, "N D"]:
    """CHS(t, m) with explicit tangents, or its derivative per keyframe interval.

    Args:
        values: at each knot. tangents: per keyframe interval.
        time: in [0, 1]; held at the ends outside.
    """
    k, r = keyframe_position(time, values.shape[1])
    weights = hermite_basis_derivative(r) if derivative else hermite_basis(r)
    return weighted(weights, knot_pair(values, k), knot_pair(tangents, k))


def weighted(
    weights: tuple[Any, Any, Any, Any], values: tuple[Tensor, Tensor], slopes: tuple[Tensor, Tensor]
) -> Tensor:
    """An interval's values and tangents, summed by the weights of `hermite_basis`."""
    total: Tensor = weights[0] * values[0] + weights[1] * slopes[0] + weights[2] * values[1]
    return total + weights[3] * slopes[1]


def catmull_rom_tangents(values: Float[Tensor, "N K D"]) -> Float[Tensor, "N K D"]:
    """tau_k = (m_{k+1} - m_{k-1}) / 2, one-sided at both ends: the finite differences that the
    paper sets against learned tangents, and the start of the learned ones."""
    steps = values[:, 1:] - values[:, :-1]
    inner = 0.5 * (steps[:, 1:] + steps[:, :-1])
    return torch.cat((steps[:, :1], inner, steps[:, -1:]), dim=1)


def catmull_rom(
    values: Float[Tensor, "N K D"], time: Time, *, derivative: bool = False
) -> Float[Tensor, "N D"]:
    """`cubic_hermite` with `catmull_rom_tangents`, from the four knots about `time` alone."""
    last = values.shape[1] - 1
    k, r = keyframe_position(time, last + 1)
    weights = hermite_basis_derivative(r) if derivative else hermite_basis(r)
    if isinstance(k, Tensor):
        near = (k + constant((-1, 0, 1, 2), k)).clamp(0, last)
        window = values.index_select(1, near)
        # over two intervals, but over one at an end
        spans = (near[2:] - near[:2])[:, None].to(values)
        slopes = (window[:, 2:] - window[:, :2]) / spans
        return weighted(weights, knot_pair(window, 1), knot_pair(slopes, 0))
    window = values[:, max(k - 1, 0) : k + 3]
    first, second = catmull_rom_tangents(window)[:, min(k, 1) : min(k, 1) + 2].unbind(1)
    return weighted(weights, knot_pair(values, k), (first, second))


def linear(values: Float[Tensor, "N K ..."], time: Time) -> Float[Tensor, "N ..."]:
    """Piecewise linear interpolation over the knots."""
    k, r = keyframe_position(time, values.shape[1])
    return lerp(*knot_pair(values, k), r)


def lerp(low: Tensor, high: Tensor, r: Any) -> Tensor:
    """torch.lerp for a position r that is a number or a 0-d tensor of any type."""
    return torch.lerp(low, high, r.to(low.dtype) if isinstance(r, Tensor) else r)


def accelerations(values: Float[Tensor, "N K D"]) -> Float[Tensor, "N K2 D"]:
    """Second differences of the knots, m_{k+1} - 2 m_k + m_{k-1}; empty for two knots."""
    return values[:, 2:] - 2 * values[:, 1:-1] + values[:, :-2]


def fit(
    samples: Float[Tensor, "F D"],
    keyframes: int,
    *,
    free_tangents: bool,
    weights: Float[Tensor, " F"] | None = None,
    smoothness: float = 1e-3,
) -> tuple[Float[Tensor, "K D"], Float[Tensor, "K D"]]:
    """Knots and tangents of the spline nearest to F samples, uniform over [0, 1].

    Linear least squares. Sampling a motion at the knots instead, with finite differences for
    tangents, cuts its corners: on a box swung at arm's length, a keyframe every 4 frames, that is
    off by 27 mm at worst, the fit by 1 mm.

    Args:
        free_tangents: fit tangents too; else they are those of `catmull_rom`.
        weights: of the samples; one each by default.
        smoothness: weight of tangents against finite differences, and of accelerations, a
            hundredth of that; it decides what the samples leave open.
    """
    count = len(samples)
    kind: dict[str, Any] = {"dtype": torch.float64, "device": samples.device}
    rows = torch.zeros(count, 2 * keyframes, **kind)
    for i in range(count):
        k, r = keyframe_position(i / max(count - 1, 1), keyframes)
        h = hermite_basis(r)
        for column, weight in zip((k, keyframes + k, k + 1, keyframes + k + 1), h, strict=True):
            rows[i, column] += weight
    eye = torch.eye(keyframes, **kind)
    differences = catmull_rom_tangents(eye[None])[0]
    whole = torch.cat((eye, differences))  # knots to knots and their finite-difference tangents
    scale = torch.ones(count, **kind) if weights is None else weights.to(**kind)
    data = scale.sqrt()[:, None] * rows
    bends = 0.1 * smoothness**0.5 * accelerations(eye[None])[0]
    if free_tangents:
        ties = smoothness**0.5 * torch.cat((differences, -eye), dim=1)
        bends = torch.cat((bends, torch.zeros_like(bends)), dim=1)
        system = torch.cat((data, ties, bends))
    else:
        system = torch.cat((data @ whole, bends))
    target = torch.zeros(len(system), samples.shape[1], **kind)
    target[:count] = scale.sqrt()[:, None] * samples.to(torch.float64)
    solution = torch.linalg.lstsq(system, target).solution
    if not free_tangents:
        solution = whole @ solution
    knots, tangents = solution.to(samples.dtype).split(keyframes)
    return knots, tangents
