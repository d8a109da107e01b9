"""Points spread evenly over a body's surface, with everything that rides along."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hoigs.core.body import BodySurface
from hoigs.core.gaussians import neighbour_distances


def sample_surface(
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    weights: Float[Tensor, "V J"],
    vertex_parts: Int[Tensor, " V"],
    count: int | None,
    seed: int,
) -> BodySurface:
    """One point a vertex (count None), or `count` by area: stratified, so spread evenly.

    Points sit at equal steps of the cumulated face area with one random shift a step, which keeps
    clumps and holes away that independent draws would have. The same seed gives the same points.
    """
    if count is None:
        face, barycentric = _at_vertices(len(vertices), faces)
    else:
        face, barycentric = _by_area(vertices, faces, count, seed)
    corners = faces[face]
    mixed = lambda values: (values[corners] * barycentric[..., None]).sum(1)  # noqa: E731
    points = mixed(vertices)
    a, b, c = vertices[corners].unbind(1)
    normals = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    nearest = corners.gather(1, barycentric.argmax(1, keepdim=True)).squeeze(1)
    return BodySurface(
        points=points,
        normals=normals,
        spacing=neighbour_distances(points),
        weights=mixed(weights),
        parts=vertex_parts[nearest],
        faces=face,
        barycentric=barycentric,
    )


def _at_vertices(
    count: int, faces: Int[Tensor, "F 3"]
) -> tuple[Int[Tensor, " V"], Float[Tensor, "V 3"]]:
    """For each vertex a face that has it, with all weight on that corner."""
    owner = torch.zeros(count, dtype=torch.int64, device=faces.device)
    corner = torch.zeros_like(owner)
    for k in range(3):
        owner[faces[:, k]] = torch.arange(len(faces), device=faces.device)
        corner[faces[:, k]] = k
    return owner, torch.nn.functional.one_hot(corner, 3).float()


def _by_area(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], count: int, seed: int
) -> tuple[Int[Tensor, " P"], Float[Tensor, "P 3"]]:
    a, b, c = vertices.detach()[faces].double().unbind(1)
    cumulated = torch.linalg.cross(b - a, c - a).norm(dim=-1).cumsum(0)
    generator = torch.Generator().manual_seed(seed)
    shift = torch.rand(count, generator=generator, dtype=torch.float64)
    steps = (torch.arange(count, dtype=torch.float64) + shift) / count
    where = steps.to(cumulated) * cumulated[-1]
    face = torch.searchsorted(cumulated, where).clamp(max=len(faces) - 1)
    u, v = torch.rand(2, count, generator=generator).to(vertices).unbind(0)
    root = u.sqrt()
    barycentric = torch.stack((1 - root, root * (1 - v), root * v), -1)
    return face, barycentric
