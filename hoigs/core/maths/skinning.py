"""Linear blend skinning of points and of orientations over a joint tree (SMPL-X's `lbs.py`)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.fast.choose import native
from hoigs.core.fast.graphs import constant
from hoigs.core.maths.rotations import (
    axis_angle_to_matrices,
    matrices_to_quats,
    multiply_quats,
    normalize_quats,
)

IDENTITY = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


@lru_cache(maxsize=32)
def _doubling_rounds(parents: tuple[int, ...]) -> tuple[tuple[int, ...], ...]:
    """For each round 0, 1, … the index of each joint's ancestor 2^round levels up.

    Index 0 stands for no ancestor, j + 1 for joint j. The last round reaches the root from every
    joint.
    """
    depth: list[int] = []
    for joint, parent in enumerate(parents):
        if parent >= joint or (parent < 0) != (joint == 0):
            raise ValueError(
                f"joint {joint} has parent {parent}: expected joint 0 as the only root (parent -1) "
                "and every parent before its children"
            )
        depth.append(0 if parent < 0 else depth[parent] + 1)
    above = (0, *(parent + 1 for parent in parents))
    rounds = []
    for _ in range(max(depth).bit_length()):
        rounds.append(above)
        above = tuple(above[index] for index in above)
    return tuple(rounds)


def joint_transforms(
    rotations: Float[Tensor, "*batch J 3"],
    joints: Float[Tensor, "*shape J 3"],
    parents: Sequence[int],
    transl: Float[Tensor, "*batch 3"],
) -> Float[Tensor, "*batch J 4 4"]:
    """World transform of each joint times its inverse rest transform (SMPL-X, `lbs.py` order).

    Args:
        rotations: local rotations, axis-angle, radians; zero is the rest pose.
        joints: rest positions, metres; may lack the batch.
        parents: -1 for joint 0, the root; every parent stands before its children.
        transl: added last, metres.

    Raises:
        ValueError: the parents are not such a tree.
    """
    parents = tuple(parents)
    rounds = _doubling_rounds(parents)
    joints = joints.expand(rotations.shape)
    # an extra joint with the identity transform stands before the root and is its parent
    bases = torch.cat((-transl[..., None, :], joints), -2)
    above = constant(tuple(parent + 1 for parent in parents), joints, torch.long)
    bones = joints - bases.index_select(-2, above)
    local = torch.cat((axis_angle_to_matrices(rotations), bones[..., None]), -1)
    last = constant((0.0, 0.0, 0.0, 1.0), local).expand(*local.shape[:-2], 1, 4)
    local = torch.cat((local, last), -2)
    none = constant(IDENTITY, local).expand(*local.shape[:-3], 1, 4, 4)
    world = torch.cat((none, local), -3)
    # the chain of each joint doubles in every round: 4 products for a body with hands, where one
    # product for each level of the tree would be 12
    for indices in rounds:
        world = world.index_select(-3, constant(indices, world, torch.long)) @ world
    top = world[..., 1:, :3, :]
    rotation, position = top[..., :3], top[..., 3]
    shift = position - (rotation @ joints[..., None])[..., 0]
    return torch.cat((torch.cat((rotation, shift[..., None]), -1), last), -2)


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
        above = constant(tuple(max(p, 0) for p in parents), quats, torch.long)
        above = quats.index_select(0, above)
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
    kernels = native("skin", points, quats, weights, transforms, turns)
    if kernels is not None and kernels.fits(len(turns)):
        table = torch.cat((transforms[:, :3].flatten(1), turns), 1)
        means, turned = kernels.SkinnedGaussians.apply(points, quats, weights, table)
        return means, turned
    turned = multiply_quats(normalize_quats(weights @ turns), quats)
    return skin(points, transforms, weights), turned
