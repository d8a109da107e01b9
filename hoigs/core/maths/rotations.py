"""Rotations: quaternions are wxyz; matrices act on column vectors; axis-angle is in radians."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.device import constant, replaceable

# Products of quaternions, and the matrices of their rotations, are sums of a few products a_i b_j.
# A table of coefficients makes each of them two operations on all rows instead of thirty.
_W, _X, _Y, _Z = range(4)


def _table(sums: Sequence[Mapping[int, float]], rows: int) -> tuple[tuple[float, ...], ...]:
    """[rows, len(sums)]: the coefficient of each row in each of the sums."""
    return tuple(tuple(terms.get(row, 0.0) for terms in sums) for row in range(rows))


def _products(*terms: tuple[float, int, int]) -> dict[int, float]:
    found: dict[int, float] = {}
    for sign, i, j in terms:
        found[4 * i + j] = found.get(4 * i + j, 0.0) + sign
    return found


HAMILTON = _table(
    [
        _products((1, _W, _W), (-1, _X, _X), (-1, _Y, _Y), (-1, _Z, _Z)),
        _products((1, _W, _X), (1, _X, _W), (1, _Y, _Z), (-1, _Z, _Y)),
        _products((1, _W, _Y), (-1, _X, _Z), (1, _Y, _W), (1, _Z, _X)),
        _products((1, _W, _Z), (1, _X, _Y), (-1, _Y, _X), (1, _Z, _W)),
    ],
    16,
)
MATRIX_OF_PAIRS = _table(  # less the identity; rows of the matrix one after the other
    [
        _products((-2, _Y, _Y), (-2, _Z, _Z)),
        _products((2, _X, _Y), (-2, _W, _Z)),
        _products((2, _X, _Z), (2, _W, _Y)),
        _products((2, _X, _Y), (2, _W, _Z)),
        _products((-2, _X, _X), (-2, _Z, _Z)),
        _products((2, _Y, _Z), (-2, _W, _X)),
        _products((2, _X, _Z), (-2, _W, _Y)),
        _products((2, _Y, _Z), (2, _W, _X)),
        _products((-2, _X, _X), (-2, _Y, _Y)),
    ],
    16,
)
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
# 4 q_i (w, x, y, z) for each pivot i, from a matrix's entries m_00, m_01, ... m_22
_A, _B, _C = {7: 1.0, 5: -1.0}, {2: 1.0, 6: -1.0}, {3: 1.0, 1: -1.0}
_D, _E, _F = {3: 1.0, 1: 1.0}, {2: 1.0, 6: 1.0}, {7: 1.0, 5: 1.0}
PIVOTS = _table(
    [
        {0: 1.0, 4: 1.0, 8: 1.0}, _A, _B, _C,
        _A, {0: 1.0, 4: -1.0, 8: -1.0}, _D, _E,
        _B, _D, {0: -1.0, 4: 1.0, 8: -1.0}, _F,
        _C, _E, _F, {0: -1.0, 4: -1.0, 8: 1.0},
    ],
    9,
)  # fmt: skip
HAMILTON_OF_CONJUGATE = tuple(  # of a * conjugate(b); every first of four rows is of b's w
    tuple(-value if row % 4 else value for value in values) for row, values in enumerate(HAMILTON)
)
UNIT_PIVOTS = (
    (1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0)
)  # fmt: skip


def normalize_quats(quats: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions. A zero quaternion stays zero rather than becoming NaN."""
    return quats / quats.norm(dim=-1, keepdim=True).clamp_min(1e-12)


def multiply_quats(
    a: Float[Tensor, "*batch 4"], b: Float[Tensor, "*batch 4"]
) -> Float[Tensor, "*batch 4"]:
    """Hamilton product a*b: rotate by b first, then by a."""
    return _pairs(a, b) @ constant(HAMILTON, a)


@replaceable
def turned_quats(change: Float[Tensor, "N 4"], quats: Float[Tensor, "N 4"]) -> Float[Tensor, "N 4"]:
    """Unit quaternions of rotations by `quats` and then by normalise((1, 0, 0, 0) + change)."""
    turn = normalize_quats(change + constant((1.0, 0.0, 0.0, 0.0), change))
    return multiply_quats(turn, normalize_quats(quats))


def conjugate_quats(quats: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """The inverses of unit quaternions."""
    return quats * constant((1.0, -1.0, -1.0, -1.0), quats)


def relative_quats(
    after: Float[Tensor, "*batch 4"], before: Float[Tensor, "*batch 4"]
) -> Float[Tensor, "*batch 4"]:
    """after * conjugate(before): the turn between them, times the product of their lengths."""
    return _pairs(after, before) @ constant(HAMILTON_OF_CONJUGATE, after)


def quats_to_matrices(quats: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of quaternions, which need not be normalised."""
    unit = normalize_quats(quats)
    turn = _pairs(unit, unit) @ constant(MATRIX_OF_PAIRS, unit)
    return (turn + constant(IDENTITY, unit)).unflatten(-1, (3, 3))


def move_rigidly(
    points: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    turn: Float[Tensor, " 4"],
    shift: Float[Tensor, " 3"],
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 4"]]:
    """Points and rotations after x -> R x + t; rotations keep the length of their quaternions.

    Args:
        turn: R, a unit quaternion. shift: t.
    """
    return points @ quats_to_matrices(turn).mT + shift, multiply_quats(turn.expand_as(quats), quats)


def matrices_to_quats(matrices: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions (w may be negative) of rotation matrices; stable at every angle.

    Of the four classical formulas the one with the largest pivot is used (Shepperd, 1978).
    """
    flat = matrices.flatten(-2)
    candidates = (flat @ constant(PIVOTS, flat)).unflatten(-1, (4, 4))
    candidates = candidates + constant(UNIT_PIVOTS, flat)
    squares = candidates.detach().diagonal(dim1=-2, dim2=-1)
    pick = squares.argmax(-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    return normalize_quats(candidates.gather(-2, pick).squeeze(-2))


def _pairs(a: Tensor, b: Tensor) -> Tensor:
    """All 16 products of a component of one and a component of the other."""
    return (a[..., :, None] * b[..., None, :]).flatten(-2)


def axis_angle_to_quats(vectors: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions of axis-angle vectors; value and gradient finite at zero."""
    squared = (vectors * vectors).sum(-1, keepdim=True)
    small = squared < 1e-8
    angle = torch.where(small, torch.ones_like(squared), squared).sqrt()
    scale = torch.where(small, 0.5 - squared / 48, torch.sin(angle / 2) / angle)
    w = torch.where(small, 1 - squared / 8, torch.cos(angle / 2))
    return torch.cat((w, vectors * scale), dim=-1)


def axis_angle_to_matrices(vectors: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of axis-angle vectors (the exponential map), smooth at zero."""
    return quats_to_matrices(axis_angle_to_quats(vectors))


def quats_to_axis_angle(quats: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3"]:
    """Axis-angle vectors of norm at most pi."""
    q = normalize_quats(quats)
    q = torch.where(q[..., :1] < 0, -q, q)
    sine = q[..., 1:].norm(dim=-1, keepdim=True)
    small = sine < 1e-6
    safe = torch.where(small, torch.ones_like(sine), sine)
    angle = 2 * torch.atan2(safe, q[..., :1])
    return q[..., 1:] * torch.where(small, torch.full_like(sine, 2.0), angle / safe)


def turn_between(
    a: Float[Tensor, "*batch 4"], b: Float[Tensor, "*batch 4"]
) -> Float[Tensor, "*batch 3"]:
    """log(a^-1 b): axis-angle of the shorter turn from a to b, in a's frame.

    q and -q are one rotation; the logarithm takes the hemisphere with w >= 0, so a sign that flips
    between two knots, or a turn across the seam at 360 degrees, changes nothing.
    """
    inverse = conjugate_quats(normalize_quats(a))
    return quats_to_axis_angle(multiply_quats(inverse, normalize_quats(b)))


def matrices_to_axis_angle(matrices: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Axis-angle vectors of rotation matrices (the logarithm)."""
    return quats_to_axis_angle(matrices_to_quats(matrices))


def kabsch(source: Float[Tensor, "P 3"], target: Float[Tensor, "P 3"]) -> Float[Tensor, "3 3"]:
    """The rotation R that best takes the centred `source` onto the centred `target` (Kabsch 1976).

    Least squares over R of |R (source - mean) - (target - mean)|, never a mirror; P >= 3.
    """
    u, _, vt = torch.linalg.svd((target - target.mean(0)).mT @ (source - source.mean(0)))
    sign = torch.ones(3).to(source)
    sign[2] = torch.sign(torch.linalg.det(u @ vt))
    return u @ torch.diag(sign) @ vt


def slerp(
    a: Float[Tensor, "*batch 4"], b: Float[Tensor, "*batch 4"], r: Float[Tensor, "*rest"] | float
) -> Float[Tensor, "*batch 4"]:
    """Spherical interpolation along the shorter arc (HOIGS, "SLERP of keyframe rotations").

    A pair more than 90 degrees apart in R^4 is flipped to the same hemisphere, so that q and -q
    interpolate alike; nearly equal pairs fall back to normalised linear interpolation, which keeps
    value and gradient finite.

    Args:
        a, b: quaternions, raw (normalised here).
        r: position between them in [0, 1]; broadcasts against the batch with a last axis of 1.
    """
    a, b = normalize_quats(a), normalize_quats(b)
    dot = (a * b).sum(-1, keepdim=True)
    b = torch.where(dot < 0, -b, b)
    dot = dot.abs()
    near = dot > 0.9995
    angle = torch.acos(torch.where(near, 0.5, dot))
    sine = torch.sin(angle)
    wa = torch.where(near, 1 - r, torch.sin((1 - r) * angle) / sine)
    wb = torch.where(near, r, torch.sin(r * angle) / sine)
    return normalize_quats(wa * a + wb * b)


def exp_se3(
    turns: Float[Tensor, "*batch 3"], shifts: Float[Tensor, "*batch 3"]
) -> tuple[Float[Tensor, "*batch 4"], Float[Tensor, "*batch 3"]]:
    """Exponential map of se(3): quaternions R and translations of x -> R x + t, smooth at zero.

    t = (I + (1 - cos a) / a^2 W + (a - sin a) / a^3 W^2) v with a = |w| and W = [w]_x (Nerfies,
    Park et al. 2021, eq. 8-10, times a).

    Args:
        turns: w, axis-angle, radians. shifts: v, in the units of the translation.
    """
    squared = (turns * turns).sum(-1, keepdim=True)
    small = squared < 1e-4
    angle = torch.where(small, torch.ones_like(squared), squared).sqrt()
    first = torch.where(small, 0.5 - squared / 24, (1 - torch.cos(angle)) / angle**2)
    second = torch.where(small, 1 / 6 - squared / 120, (angle - torch.sin(angle)) / angle**3)
    once = torch.linalg.cross(turns, shifts)
    twice = torch.linalg.cross(turns, once)
    return axis_angle_to_quats(turns), shifts + first * once + second * twice
