"""Linear blend skinning over a joint tree: the maths that every body shares."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.clock import constant
from hoigs.core.rotation import axis_angle_to_matrices

UNMOVED = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


@lru_cache(maxsize=32)
def _ancestors(parents: tuple[int, ...]) -> tuple[tuple[int, ...], ...]:
    """Places of each joint's ancestor 1, 2, 4, … above it, place 0 for none and j + 1 for joint j;
    as many rounds as bring every joint to the root."""
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
        above = tuple(above[place] for place in above)
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
        parents: -1 for joint 0, the root; parents before children (else ValueError).
        transl: added last, metres.
    """
    parents = tuple(parents)
    rounds = _ancestors(parents)
    joints = joints.expand(rotations.shape)
    # before the root stands a joint without a transform: it is the parent of all that have none
    bases = torch.cat((-transl[..., None, :], joints), -2)
    above = constant(tuple(parent + 1 for parent in parents), joints, torch.long)
    bones = joints - bases.index_select(-2, above)
    local = torch.cat((axis_angle_to_matrices(rotations), bones[..., None]), -1)
    last = constant((0.0, 0.0, 0.0, 1.0), local).expand(*local.shape[:-2], 1, 4)
    local = torch.cat((local, last), -2)
    none = constant(UNMOVED, local).expand(*local.shape[:-3], 1, 4, 4)
    world = torch.cat((none, local), -3)
    # each joint's chain doubles in a round: 4 products for a body with hands, not one a depth
    for places in rounds:
        world = world.index_select(-3, constant(places, world, torch.long)) @ world
    top = world[..., 1:, :3, :]
    rotation, position = top[..., :3], top[..., 3]
    shift = position - (rotation @ joints[..., None])[..., 0]
    return torch.cat((torch.cat((rotation, shift[..., None]), -1), last), -2)


def transform_points(
    transforms: Float[Tensor, "*batch J 4 4"], points: Float[Tensor, "*shape J 3"]
) -> Float[Tensor, "*batch J 3"]:
    """One point a transform, for example each joint's own place; `points` may lack the batch."""
    return (transforms[..., :3, :3] @ points[..., None])[..., 0] + transforms[..., :3, 3]


def skin(
    points: Float[Tensor, "*shape V 3"],
    transforms: Float[Tensor, "*batch J 4 4"],
    weights: Float[Tensor, "V J"],
) -> Float[Tensor, "*batch V 3"]:
    """Points moved by the weighted mean of joint transforms; `points` may lack the batch."""
    blended = (weights @ transforms[..., :3, :].flatten(-2)).unflatten(-1, (3, 4))
    return (blended[..., :3] @ points[..., None])[..., 0] + blended[..., 3]
