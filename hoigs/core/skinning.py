"""Forward kinematics of a joint tree, linear blend skinning, and points on a mesh surface."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor


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


def pose_joints(
    rotations: Float[Tensor, "*batch J 3 3"],
    joints: Float[Tensor, "*shape J 3"],
    parents: Sequence[int],
) -> tuple[Float[Tensor, "*batch J 3 3"], Float[Tensor, "*batch J 3"]]:
    """World rotation and position of each joint of a tree (forward kinematics).

    Joint j turns by rotations[j] about its own place, in a frame that is aligned with the world
    at rest, and carries its children (methods C.9; Loper 2015, SMPL).

    Args:
        rotations: of each joint relative to its parent. joints: at rest, metres; may lack the
            batch. parents: -1 for joint 0, and every parent before its children.
    """
    joints = joints.expand(*rotations.shape[:-2], 3)
    above = [max(p, 0) for p in parents]
    offsets = joints - joints[..., above, :]
    levels, order = _levels(tuple(parents))
    turn, place = rotations[..., :1, :, :], joints[..., :1, :]
    turns, places = [turn], [place]
    for indices, parent in levels[1:]:
        base = turn[..., parent, :, :]
        place = place[..., parent, :] + (base @ offsets[..., indices, :, None]).squeeze(-1)
        turn = base @ rotations[..., indices, :, :]
        turns.append(turn)
        places.append(place)
    return torch.cat(turns, -3)[..., order, :, :], torch.cat(places, -2)[..., order, :]


def skinning_matrices(
    rotations: Float[Tensor, "*batch J 3 3"],
    positions: Float[Tensor, "*batch J 3"],
    joints: Float[Tensor, "*shape J 3"],
) -> Float[Tensor, "*batch J 4 4"]:
    """World transform of each joint times its inverse rest transform: x -> R (x - joint) + position.

    Args:
        rotations, positions: of each joint in the world. joints: at rest, may lack the batch.
    """
    shift = positions - (rotations @ joints[..., None]).squeeze(-1)
    top = torch.cat((rotations, shift[..., None]), -1)
    bottom = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*top.shape[:-2], 1, 4)
    return torch.cat((top, bottom), -2)


def blend(
    points: Float[Tensor, "*shape N 3"],
    weights: Float[Tensor, "N J"],
    transforms: Float[Tensor, "*batch J 4 4"],
) -> Float[Tensor, "*batch N 3"]:
    """Linear blend skinning, sum_j w_j T_j x; `points` may lack the batch."""
    mixed = (weights @ transforms[..., :3, :].flatten(-2)).unflatten(-1, (3, 4))
    return (mixed[..., :3] @ points[..., None]).squeeze(-1) + mixed[..., 3]


def triangle_areas(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> tuple[Float[Tensor, " F"], Float[Tensor, "F 3"]]:
    """Area of each triangle, and its normal by the right-hand rule (zero when degenerate)."""
    a, b, c = vertices[faces].unbind(1)
    cross = torch.linalg.cross(b - a, c - a)
    size = cross.norm(dim=-1)
    return size / 2, cross / size.clamp_min(1e-20)[:, None]


def vertex_normals(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, "V 3"]:
    """Unit normals, triangles weighted by area; zero for a vertex without triangles."""
    areas, normals = triangle_areas(vertices, faces)
    total = torch.zeros_like(vertices)
    for corner in range(3):
        total = total.index_add(0, faces[:, corner], normals * areas[:, None])
    return total / total.norm(dim=-1, keepdim=True).clamp_min(1e-20)


def sample_triangles(
    areas: Float[Tensor, " F"], count: int, seed: int = 0
) -> tuple[Int[Tensor, " P"], Float[Tensor, "P 3"]]:
    """`count` points spread evenly by area: the face of each and its barycentric coordinates.

    Systematic sampling: equal steps along the cumulated area, so a region's number of points
    is off its share by less than one; inside a face the point is uniform (Osada 2002, eq. 1).
    """
    rng = np.random.default_rng(seed)
    ends = np.cumsum(areas.detach().cpu().double().numpy())
    ticks = (np.arange(count) + rng.random(count)) / count * ends[-1]
    faces = np.minimum(np.searchsorted(ends, ticks, side="right"), len(ends) - 1)
    root, share = np.sqrt(rng.random(count)), rng.random(count)
    barycentric = np.stack((1 - root, root * (1 - share), root * share), -1)
    return (
        torch.from_numpy(faces).to(areas.device),
        torch.from_numpy(barycentric).to(areas),
    )


def neighbour_spacing(points: Float[Tensor, "P 3"], neighbours: int = 3) -> Float[Tensor, " P"]:
    """Mean distance from each point to its nearest others, metres (3DGS's initial scale)."""
    from scipy.spatial import cKDTree

    count = min(neighbours, len(points) - 1)
    if count < 1:
        raise ValueError(f"spacing needs at least two points, got {len(points)}")
    cloud = points.detach().cpu().double().numpy()
    distance, _ = cKDTree(cloud).query(cloud, k=count + 1)
    return torch.from_numpy(distance[:, 1:].mean(1)).to(points)
