"""Limbs at the start of the body fit: hips, knees, shoulders and elbows from 3D landmarks."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.maths.rotations import matrices_to_axis_angle

# joints (root, hinge), landmarks (root, middle, end), bone direction and hinge axis at rest.
# About its hinge a positive angle bends: knees backwards, elbows forwards.
LIMBS = (
    (16, 18, (11, 13, 15), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0)),
    (17, 19, (12, 14, 16), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    (1, 4, (23, 25, 27), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0)),
    (2, 5, (24, 26, 28), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0)),
)
STRAIGHT = 0.3  # sine of the bend below which the limb's own plane is not to be trusted


def limb_pose(
    world: Float[Tensor, "S 33 3"], torso: Float[Tensor, "S 3 3"]
) -> Float[Tensor, "S 21 3"]:
    """Axis-angle of the body joints that turn each limb onto the landmarks; others are zero.

    Args:
        world: landmarks, any one frame of axes. torso: rotation from the rest pose to that frame.
    """
    pose = world.new_zeros(len(world), 21, 3)
    for root, hinge, marks, along, about in LIMBS:
        points = world[:, list(marks)] @ torso  # in the torso's axes: rows times R is R^T x
        upper, lower = (
            torch.nn.functional.normalize(points[:, k + 1] - points[:, k], dim=-1) for k in (0, 1)
        )
        rest, axis = world.new_tensor(along), world.new_tensor(about)
        # a straight limb has no plane: there the turn of the bone alone gives the hinge's axis
        plain = (_smallest_turn(rest, upper) @ axis[:, None])[..., 0]
        seen = torch.linalg.cross(upper, lower)
        turned = _frame(upper, seen + STRAIGHT * plain)
        turn = turned @ _frame(rest[None], axis[None]).mT
        bend = torch.atan2(
            (torch.linalg.cross(upper, lower) * turned[..., 1]).sum(-1), (upper * lower).sum(-1)
        )
        pose[:, root - 1] = matrices_to_axis_angle(turn)
        pose[:, hinge - 1] = bend.clamp_min(0)[:, None] * axis
    return pose


def _frame(along: Float[Tensor, "S 3"], about: Float[Tensor, "S 3"]) -> Float[Tensor, "S 3 3"]:
    """Right-handed frames with columns `along`, `about` made orthogonal to it, and the third."""
    about = about - (about * along).sum(-1, keepdim=True) * along
    about = torch.nn.functional.normalize(about, dim=-1)
    return torch.stack((along, about, torch.linalg.cross(along, about)), -1)


def _smallest_turn(rest: Float[Tensor, "3"], upper: Float[Tensor, "S 3"]) -> Float[Tensor, "S 3 3"]:
    """Rotations by the smallest angle that take `rest` to each of `upper`."""
    from kornia.geometry.conversions import vector_to_skew_symmetric_matrix

    cross = vector_to_skew_symmetric_matrix(torch.linalg.cross(rest.expand_as(upper), upper))
    cosine = (upper @ rest)[:, None, None]
    return torch.eye(3).to(upper) + cross + cross @ cross / (1 + cosine).clamp_min(1e-3)
