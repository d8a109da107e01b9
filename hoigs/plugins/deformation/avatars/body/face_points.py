"""Which points of a body are its face, found from its shape."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hoigs.core.interfaces.body import HEAD_PART

HEAD_JOINT = 15  # of SMPL-X's order, at the height of the ears' lower ends
FORWARD = 0.35  # cosine between a face's normal and straight ahead


def face_points(
    vertices: Float[Tensor, "V 3"],
    head: Float[Tensor, " 3"],
    triangles: Int[Tensor, "N 3"],
    parts: Int[Tensor, " N"],
    barycentric: Float[Tensor, "N 3"],
) -> tuple[Int[Tensor, " F"], Float[Tensor, "F 3"]]:
    """Rows of surface points on the face, and their outward unit normals.

    Every body faces +z in its zero pose, so the face is the part of the head whose normals point
    ahead, from a quarter of the head's height below its joint (the chin; the neck belongs to the
    same part) to four fifths of it above (the hair).

    Args:
        vertices: of the zero pose, metres. head: joint 15 there.
        triangles: corners of the triangle on which each point lies.
        parts: body part of each point.
    """
    a, b, c = vertices[triangles].unbind(1)
    normals = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    height = (vertices[triangles] * barycentric[..., None]).sum(1)[:, 1] - head[1]
    mine = parts == HEAD_PART
    if not mine.any():
        return mine.nonzero().squeeze(1), normals[:0]
    top = height[mine].max()
    ahead = (normals[:, 2] > FORWARD) & (height > -0.25 * top) & (height < 0.8 * top)
    rows = (mine & ahead).nonzero().squeeze(1)
    return rows, normals[rows]
