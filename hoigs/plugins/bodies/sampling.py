"""Points spread evenly over the surface of a body, with weights, parts and triangles."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hoigs.core.interfaces.body import BodySurface
from hoigs.core.values.gaussians import neighbour_distances


def sample_surface(
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    weights: Float[Tensor, "V J"],
    vertex_parts: Int[Tensor, " V"],
    count: int | None,
    seed: int,
) -> BodySurface:
    """One point at each vertex (count None), or `count` points spread evenly by area.

    The points are at equal steps of the cumulated face area, each randomly shifted within its step,
    which avoids the clusters and gaps of independent draws. A seed always gives the same points.
    """
    if count is None:
        face, barycentric = _at_vertices(vertices, faces)
    else:
        face, barycentric = _by_area(vertices, faces, count, seed)
    corners = faces[face]
    interpolated = lambda values: (values[corners] * barycentric[..., None]).sum(1)  # noqa: E731
    points = interpolated(vertices)
    normals = vertex_normals(vertices, faces) if count is None else _directed(vertices, corners)
    nearest = corners.gather(1, barycentric.argmax(1, keepdim=True)).squeeze(1)
    return BodySurface(
        points=points,
        normals=torch.nn.functional.normalize(normals, dim=-1),
        spacing=neighbour_distances(points),
        weights=interpolated(weights),
        parts=vertex_parts[nearest],
        faces=face,
        barycentric=barycentric,
    )


def vertex_normals(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, "V 3"]:
    """Sum of the adjoining triangles' normals, longer for larger ones; not of unit length."""
    normals = _directed(vertices, faces)
    total = torch.zeros_like(vertices)
    for corner in range(3):
        total = total.index_add(0, faces[:, corner], normals)
    return total


def _directed(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "F 3"]:
    """Right-hand normal of each triangle, twice its area long."""
    a, b, c = vertices[faces].unbind(1)
    return torch.linalg.cross(b - a, c - a)


def _at_vertices(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> tuple[Int[Tensor, " V"], Float[Tensor, "V 3"]]:
    """For each vertex a face with that corner, and barycentric coordinates of the corner."""
    count = len(vertices)
    owner = torch.zeros(count, dtype=torch.int64, device=faces.device)
    corner = torch.zeros_like(owner)
    for k in range(3):
        owner[faces[:, k]] = torch.arange(len(faces), device=faces.device)
        corner[faces[:, k]] = k
    return owner, torch.nn.functional.one_hot(corner, 3).to(vertices)


def _by_area(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], count: int, seed: int
) -> tuple[Int[Tensor, " P"], Float[Tensor, "P 3"]]:
    cumulated = _directed(vertices.detach().double(), faces).norm(dim=-1).cumsum(0)
    generator = torch.Generator().manual_seed(seed)
    shift = torch.rand(count, generator=generator, dtype=torch.float64)
    steps = (torch.arange(count, dtype=torch.float64) + shift) / count
    where = steps.to(cumulated) * cumulated[-1]
    face = torch.searchsorted(cumulated, where).clamp(max=len(faces) - 1)
    u, v = torch.rand(2, count, generator=generator).to(vertices).unbind(0)
    root = u.sqrt()
    barycentric = torch.stack((1 - root, root * (1 - v), root * v), -1)
    return face, barycentric
