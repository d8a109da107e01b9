"""Splines of rotations with angular velocities: cubic Hermite curves of unit quaternions."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.device import constant
from hoigs.core.maths.rotations import (
    axis_angle_to_quats,
    conjugate_quats,
    multiply_quats,
    normalize_quats,
    quats_to_axis_angle,
    quats_to_matrices,
    turn_between,
)


def angular_differences(
    quats: Float[Tensor, "K 4"], lengths: Float[Tensor, " J"]
) -> Float[Tensor, "K 3"]:
    """Angular velocity at each knot by finite differences: `splines.finite_differences` of
    rotations.

    In the frame of the rotation at the knot, radians per unit of `lengths`, the distances of
    neighbouring knots (J = K - 1); one-sided at both ends.
    """
    turns = turn_between(quats[:-1], quats[1:]) / lengths[:, None]
    before, after = lengths[:-1, None], lengths[1:, None]
    # a turn's axis is the same in the frames of both its ends, so the two sides may be averaged
    inner = (after * turns[:-1] + before * turns[1:]) / (before + after)
    return torch.cat((turns[:1], inner, turns[-1:]))


# Coefficients of r, r^2, r^3 (rows) in the cumulative Bernstein polynomials B1, B2, B3 (columns),
# and of 1, r, r^2 in their derivatives.
CUMULATIVE = ((3.0, 0.0, 0.0), (-3.0, 3.0, 0.0), (1.0, -2.0, 1.0))
CUMULATIVE_DERIVATIVE = ((3.0, 0.0, 0.0), (-6.0, 6.0, 0.0), (3.0, -6.0, 3.0))


def hermite_quats(
    a: Float[Tensor, "*batch 4"],
    b: Float[Tensor, "*batch 4"],
    velocity_a: Float[Tensor, "*batch 3"],
    velocity_b: Float[Tensor, "*batch 3"],
    r: Float[Tensor, "*batch 1"] | float,
    length: Float[Tensor, "*batch 1"] | float = 1.0,
) -> tuple[Float[Tensor, "*batch 4"], Float[Tensor, "*batch 3"]]:
    """Rotation and angular velocity at r in [0, 1] of an interval from a to b.

    q(r) = a exp(w1 B1) exp(w2 B2) exp(w3 B3) with the cumulative Bernstein polynomials B, w1 and
    w3 a third of the end velocities, and w2 the rest of the turn (Kim, Kim and Shin 1995, "A
    general construction scheme for unit quaternion curves", Hermite quaternion curves). It passes
    through a and b with those velocities, and turns at constant speed where both equal the turn.

    Args:
        velocity_a, velocity_b: in the frames of a and b, radians per unit.
        length: interval length, in the same unit.
    """
    quat, turns, factors = hermite_factors(a, b, velocity_a, velocity_b, r, length)
    rates = turns * _polynomials(CUMULATIVE_DERIVATIVE, r, turns, 0)
    first, second, third = rates.unbind(-2)
    # each factor's velocity, carried through the factors on its right into the final frame
    speed = _inverse_rotated(factors[..., 1, :], first) + second
    speed = _inverse_rotated(factors[..., 2, :], speed) + third
    return quat, speed / length


def hermite_factors(
    a: Tensor, b: Tensor, velocity_a: Tensor, velocity_b: Tensor, r: Any, length: Any = 1.0
) -> tuple[Float[Tensor, "*batch 4"], Float[Tensor, "*batch 3 3"], Float[Tensor, "*batch 3 4"]]:
    """Terms of `hermite_quats`, with its arguments: q(r), then w1, w2, w3 in radians and their
    three factors. Equal steps are computed together, because on a GPU each small operation costs
    its launch."""
    ends = normalize_quats(torch.stack((a, b), -2))
    w1, w3 = velocity_a * (length / 3), velocity_b * (length / 3)
    inner = multiply_quats(ends, axis_angle_to_quats(torch.stack((w1, -w3), -2)))
    start, end = inner.unbind(-2)
    w2 = quats_to_axis_angle(multiply_quats(conjugate_quats(start), end))
    turns = torch.stack((w1, w2, w3), -2)
    factors = axis_angle_to_quats(turns * _polynomials(CUMULATIVE, r, turns, 1))
    q1, q2, q3 = factors.unbind(-2)
    quat = multiply_quats(multiply_quats(ends[..., 0, :], q1), multiply_quats(q2, q3))
    return normalize_quats(quat), turns, factors


def _polynomials(table: Any, r: Any, like: Tensor, lowest: int) -> Tensor:
    """Three polynomials in r, a column of `table` each, as [*batch, 3, 1]; powers from `lowest`."""
    r = r if isinstance(r, Tensor) else like.new_full((1,), r)
    powers = constant(tuple(range(lowest, lowest + 3)), like)
    return (r.to(like) ** powers @ constant(table, like))[..., None]


def _inverse_rotated(quat: Tensor, vector: Tensor) -> Tensor:
    return (quats_to_matrices(quat).mT @ vector[..., None]).squeeze(-1)
