"""Rotations: quaternions are wxyz; matrices act on column vectors; axis-angle is in radians."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def normalize_quats(quats: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions. A zero quaternion stays zero rather than becoming NaN."""
    return quats / quats.norm(dim=-1, keepdim=True).clamp_min(1e-12)


def multiply_quats(
    a: Float[Tensor, "*batch 4"], b: Float[Tensor, "*batch 4"]
) -> Float[Tensor, "*batch 4"]:
    """Hamilton product a*b: rotate by b first, then by a."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ),
        dim=-1,
    )


def quats_to_matrices(quats: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of quaternions, which need not be normalised."""
    w, x, y, z = normalize_quats(quats).unbind(-1)
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def matrices_to_quats(matrices: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions (w may be negative) of rotation matrices; stable at every angle.

    Of the four classical formulas the one with the largest pivot is used (Shepperd, 1978).
    """
    m = matrices
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    squares = torch.stack(
        (1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22), -1
    )
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    d, e, f = m[..., 1, 0] + m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 2, 1] + m[..., 1, 2]
    candidates = torch.stack(
        (
            torch.stack((squares[..., 0], a, b, c), -1),
            torch.stack((a, squares[..., 1], d, e), -1),
            torch.stack((b, d, squares[..., 2], f), -1),
            torch.stack((c, e, f, squares[..., 3]), -1),
        ),
        dim=-2,
    )
    pick = squares.detach().argmax(-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    return normalize_quats(candidates.gather(-2, pick).squeeze(-2))


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


def matrices_to_axis_angle(matrices: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Axis-angle vectors of rotation matrices (the logarithm)."""
    return quats_to_axis_angle(matrices_to_quats(matrices))


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
    angle = torch.acos(torch.where(near, torch.full_like(dot, 0.5), dot).clamp(max=1.0))
    sine = torch.sin(angle)
    wa = torch.where(near, 1 - r + torch.zeros_like(dot), torch.sin((1 - r) * angle) / sine)
    wb = torch.where(near, r + torch.zeros_like(dot), torch.sin(r * angle) / sine)
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
