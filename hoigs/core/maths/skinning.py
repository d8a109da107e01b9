"""Linear blend skinning of points and of orientations over a joint tree (SMPL-X's `lbs.py`)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.device import replaceable
from hoigs.core.maths.rotations import (
    axis_angle_to_matrices,
    matrices_to_quats,
    multiply_quats,
    normalize_quats,
)


def checked_tree(parents: Sequence[int]) -> tuple[int, ...]:
    """The parents of joints.

    Raises:
        ValueError: joint 0 is not the only root, or a parent does not stand before its children.
    """
    for joint, parent in enumerate(parents):
        if parent >= joint or (parent < 0) != (joint == 0):
            raise ValueError(
                f"joint {joint} has parent {parent}: expected joint 0 as the only root (parent -1) "
                "and every parent before its children"
            )
    return tuple(parents)


@replaceable
def joint_transforms(
    rotations: Float[Tensor, "*batch J 3"],
    joints: Float[Tensor, "*shape J 3"],
    parents: Sequence[int],
    transl: Float[Tensor, "*batch 3"],
) -> Float[Tensor, "*batch J 4 4"]:
    """World transform of each joint times its inverse rest transform (SMPL-X, `lbs.py` order).

    G_j = G_parent [R_j | J_j - J_parent], and T_j = G_j [1 | -J_j].

    Args:
        rotations: local rotations, axis-angle, radians; zero is the rest pose.
        joints: rest positions, metres; may lack the batch.
        parents: -1 for joint 0, the root; every parent stands before its children.
        transl: added last, metres.

    Raises:
        ValueError: the parents are not such a tree.
    """
    local = axis_angle_to_matrices(rotations).unbind(-3)
    rest = joints.expand(rotations.shape).unbind(-2)
    turns: list[Tensor] = []
    places: list[Tensor] = []
    for joint, parent in enumerate(checked_tree(parents)):
        if parent < 0:
            turns.append(local[joint])
            places.append(rest[joint] + transl)
            continue
        bone = rest[joint] - rest[parent]
        turns.append(turns[parent] @ local[joint])
        places.append(places[parent] + _turned(turns[parent], bone))
    shifts = [p - _turned(r, j) for r, p, j in zip(turns, places, rest, strict=True)]
    top = torch.cat((torch.stack(turns, -3), torch.stack(shifts, -2)[..., None]), -1)
    last = torch.eye(4, dtype=top.dtype, device=top.device)[3:]
    return torch.cat((top, last.expand(*top.shape[:-2], 1, 4)), -2)


def _turned(rotation: Float[Tensor, "*batch 3 3"], vector: Float[Tensor, "*batch 3"]) -> Tensor:
    return (rotation @ vector[..., None])[..., 0]


def transform_points(
    transforms: Float[Tensor, "*batch J 4 4"], points: Float[Tensor, "*shape J 3"]
) -> Float[Tensor, "*batch J 3"]:
    """Each point moved by its own transform; `points` may lack the batch."""
    return (transforms[..., :3, :3] @ points[..., None])[..., 0] + transforms[..., :3, 3]


def skin(
    points: Float[Tensor, "*shape V 3"],
    transforms: Float[Tensor, "*batch J 4 4"],
    weights: Float[Tensor, "V J"],
) -> Float[Tensor, "*batch V 3"]:
    """Points moved by the weighted mean of joint transforms, sum_j w_j T_j p.

    `points` may lack the batch.
    """
    blended = (weights @ transforms[..., :3, :].flatten(-2)).unflatten(-1, (3, 4))
    return (blended[..., :3] @ points[..., None])[..., 0] + blended[..., 3]


def ancestor_table(parents: Sequence[int]) -> Float[Tensor, "J J"]:
    """One where the column's joint is the row's joint or one of its ancestors, else zero."""
    table = torch.eye(len(parents))
    for joint, parent in enumerate(parents):
        if parent >= 0:
            table[joint] += table[parent]
    return table


def joint_turns(
    transforms: Float[Tensor, "J 4 4"], parents: Sequence[int], ancestors: Float[Tensor, "J J"]
) -> Float[Tensor, "J 4"]:
    """Unit quaternions of joints, of signs with which they may be averaged.

    q and -q are the same rotation, so each joint's sign is chosen to agree with its parent's, from
    the root on.

    Args:
        ancestors: `ancestor_table(parents)`.
    """
    quats = matrices_to_quats(transforms[:, :3, :3])
    with torch.no_grad():
        each = quats.unbind()
        above = torch.stack([each[max(parent, 0)] for parent in parents])
        flipped = ((quats * above).sum(-1) < 0).to(quats)
        signs = 1 - 2 * torch.remainder(ancestors @ flipped, 2)
    return quats * signs[:, None]


def skin_quats(
    transforms: Float[Tensor, "J 4 4"],
    weights: Float[Tensor, "N J"],
    parents: Sequence[int],
    ancestors: Float[Tensor, "J J"],
) -> Float[Tensor, "N 4"]:
    """Unit quaternions by which points turn: the weighted mean of the joints' quaternions.

    The weighted mean of rotation matrices shrinks and may flip where a limb is twisted (the "candy
    wrapper" artefact); the mean of quaternions remains a rotation.

    Args:
        ancestors: `ancestor_table(parents)`.
    """
    return normalize_quats(weights @ joint_turns(transforms, parents, ancestors))


@replaceable
def skin_gaussians(
    points: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    weights: Float[Tensor, "N J"],
    transforms: Float[Tensor, "J 4 4"],
    turns: Float[Tensor, "J 4"],
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 4"]]:
    """Points moved as `skin` does, and rotations turned further as `skin_quats` says.

    Args:
        turns: `joint_turns` of the transforms, or of ones that differ in scale and translation.
    """
    turned = multiply_quats(normalize_quats(weights @ turns), quats)
    return skin(points, transforms, weights), turned
