"""Linear blend skinning over a joint tree: the maths that every body shares."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.rotation import axis_angle_to_matrices


def joint_transforms(
    rotations: Float[Tensor, "*batch J 3"],
    joints: Float[Tensor, "*batch J 3"],
    parents: Sequence[int],
    transl: Float[Tensor, "*batch 3"],
) -> Float[Tensor, "*batch J 4 4"]:
    """World transform of each joint times its inverse rest transform (SMPL-X, `lbs.py` order).

    Args:
        rotations: local rotations, axis-angle, radians; zero is the rest pose.
        joints: rest positions, metres. parents: -1 for the root, parents before children.
        transl: added last, metres.
    """
    matrices = axis_angle_to_matrices(rotations)
    world_rotations: list[Tensor] = []
    world_joints: list[Tensor] = []
    for j, parent in enumerate(parents):
        if parent < 0:
            world_rotations.append(matrices[..., j, :, :])
            world_joints.append(joints[..., j, :])
            continue
        bone = joints[..., j, :] - joints[..., parent, :]
        turned = (world_rotations[parent] @ bone[..., None])[..., 0]
        world_rotations.append(world_rotations[parent] @ matrices[..., j, :, :])
        world_joints.append(world_joints[parent] + turned)
    rotation = torch.stack(world_rotations, -3)
    position = torch.stack(world_joints, -2) + transl[..., None, :]
    shift = position - (rotation @ joints[..., None])[..., 0]
    top = torch.cat((rotation, shift[..., None]), -1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 3] = 1.0
    return torch.cat((top, bottom), -2)


def skin(
    points: Float[Tensor, "*batch V 3"],
    transforms: Float[Tensor, "*batch J 4 4"],
    weights: Float[Tensor, "V J"],
) -> Float[Tensor, "*batch V 3"]:
    """Points moved by the weighted mean of joint transforms."""
    blended = torch.einsum("vj,...jab->...vab", weights, transforms[..., :3, :])
    return (blended[..., :3] @ points[..., None])[..., 0] + blended[..., 3]
