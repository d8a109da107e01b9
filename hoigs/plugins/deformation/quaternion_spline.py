"""A rotation spline with angular velocities: the cubic Hermite curve of unit quaternions."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.clock import constant
from hoigs.core.rotation import (
    axis_angle_to_quats,
    multiply_quats,
    normalize_quats,
    quats_to_axis_angle,
    quats_to_matrices,
)


def conjugate(quats: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Inverse of unit quaternions."""
    return quats * constant((1.0, -1.0, -1.0, -1.0), quats)


def turn_between(
    a: Float[Tensor, "*batch 4"], b: Float[Tensor, "*batch 4"]
) -> Float[Tensor, "*batch 3"]:
    """log(a^-1 b): axis-angle of the shorter turn from a to b, in a's frame.

    q and -q are one rotation; the logarithm takes the hemisphere with w >= 0, so a sign that flips
    between two knots, or a turn across the seam at 360 degrees, changes nothing.
    """
    return quats_to_axis_angle(multiply_quats(conjugate(normalize_quats(a)), normalize_quats(b)))


def angular_differences(
    quats: Float[Tensor, "K 4"], lengths: Float[Tensor, " J"]
) -> Float[Tensor, "K 3"]:
    """Angular velocity at each knot by finite differences: the analogue of Catmull-Rom's.

    In the frame of the rotation at the knot, radians per unit of `lengths`, the distances of
    neighbouring knots (J = K - 1); one-sided at both ends.
    """
    turns = turn_between(quats[:-1], quats[1:]) / lengths[:, None]
    before, after = lengths[:-1, None], lengths[1:, None]
    # a turn's axis is the same in the frames of both its ends, so the two sides may be averaged
    inner = (after * turns[:-1] + before * turns[1:]) / (before + after)
    return torch.cat((turns[:1], inner, turns[-1:]))


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
    w3 a third of the end velocities, and w2 what is left of the turn (Kim, Kim and Shin 1995, "A
    general construction scheme for unit quaternion curves", Hermite quaternion curves). It passes
    through a and b with those velocities, and turns at constant speed where both equal the turn.

    Args:
        velocity_a, velocity_b: in the frames of a and b, radians per unit.
        length: of the interval, in the same unit.
    """
    a, b = normalize_quats(a), normalize_quats(b)
    w1, w3 = velocity_a * (length / 3), velocity_b * (length / 3)
    start = multiply_quats(a, axis_angle_to_quats(w1))
    end = multiply_quats(b, axis_angle_to_quats(-w3))
    w2 = turn_between(start, end)
    q1 = axis_angle_to_quats(w1 * (1 - (1 - r) ** 3))
    q2 = axis_angle_to_quats(w2 * (3 * r**2 - 2 * r**3))
    q3 = axis_angle_to_quats(w3 * r**3)
    quat = multiply_quats(multiply_quats(a, q1), multiply_quats(q2, q3))
    # each factor's velocity, carried through the factors on its right into the final frame
    speed = w1 * (3 * (1 - r) ** 2)
    speed = _into(q2, speed) + w2 * (6 * r - 6 * r**2)
    speed = _into(q3, speed) + w3 * (3 * r**2)
    return normalize_quats(quat), speed / length


def _into(quat: Tensor, vector: Tensor) -> Tensor:
    return (quats_to_matrices(quat).mT @ vector[..., None]).squeeze(-1)
