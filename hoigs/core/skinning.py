"""Linear blend skinning over a joint tree: the maths that every body shares."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.rotation import axis_angle_to_matrices


@lru_cache(maxsize=32)
def _levels(parents: tuple[int, ...]) -> tuple[list[tuple[list[int], list[int]]], list[int]]:
    """Joints of each depth with their parent's place one depth above; and the order back."""
    depth: list[int] = []
    for joint, parent in enumerate(parents):
        if parent >= joint or (parent < 0) != (joint == 0):
            raise ValueError(
                f"joint {joint} has parent {parent}: expected joint 0 as the only root (parent -1) "
                "and every parent before its children"
            )
        depth.append(0 if parent < 0 else depth[parent] + 1)
    place: dict[int, int] = {}
    levels: list[tuple[list[int], list[int]]] = []
    order: list[int] = []
    for level in range(max(depth) + 1):
        joints = [j for j, d in enumerate(depth) if d == level]
        levels.append((joints, [place.get(parents[j], 0) for j in joints]))
        place = {j: i for i, j in enumerate(joints)}
        order += joints
    return levels, [order.index(j) for j in range(len(parents))]


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
    matrices = axis_angle_to_matrices(rotations)
    joints = joints.expand(rotations.shape)
    bones = joints - joints[..., [max(p, 0) for p in parents], :]
    levels, order = _levels(tuple(parents))
    # a depth of the tree at a time: 11 steps for a body with hands, not 52
    turn = matrices[..., :1, :, :]
    place = joints[..., :1, :] + transl[..., None, :]
    turns, places = [turn], [place]
    for indices, above in levels[1:]:
        base = turn[..., above, :, :]
        place = place[..., above, :] + (base @ bones[..., indices, :, None])[..., 0]
        turn = base @ matrices[..., indices, :, :]
        turns.append(turn)
        places.append(place)
    rotation = torch.cat(turns, -3)[..., order, :, :]
    position = torch.cat(places, -2)[..., order, :]
    shift = position - (rotation @ joints[..., None])[..., 0]
    top = torch.cat((rotation, shift[..., None]), -1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 3] = 1.0
    return torch.cat((top, bottom), -2)


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
