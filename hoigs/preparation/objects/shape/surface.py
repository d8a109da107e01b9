"""The mesh that an alignment starts from: the visual hull of the masks at rough poses."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from hoigs.preparation.objects.alignment import Poses, Surface
from hoigs.preparation.objects.crops import Crops

DIVISIONS = 3  # of an icosahedron: 642 vertices
SHELLS = 40  # distances tried along each ray
CARVED = 0.1  # share of the frames that may show background at a point of the hull


def hull(
    crops: Crops, poses: Poses, radius: float, samples: int, carved: float = CARVED
) -> Surface:
    """A mesh whose vertices lie on rays from the object's middle, as far out as masks allow.

    A place belongs to the object unless more than `carved` of the frames show background there;
    pixels of the person do not count, as they may hide it. The mesh is star-shaped about the
    object's middle: holes and deep hollows are filled.

    Args:
        radius: metres within which the object lies. samples: points on the surface.
    """
    directions, faces = _sphere(DIVISIONS)
    reach = reaches(crops, poses, directions, radius, carved)
    return with_samples(directions * reach[:, None], faces, samples)


def reaches(
    crops: Crops, poses: Poses, directions: Float[Tensor, "V 3"], radius: float, carved: float
) -> Float[Tensor, " V"]:
    """Metres from the object's middle along unit rays to the hull."""
    steps = torch.linspace(0.05, 1.0, SHELLS) * radius
    places = directions[:, None] * steps[:, None]  # V, S, 3
    flat = places.flatten(0, 1)
    background = torch.zeros(len(flat))
    known = torch.zeros(len(flat))
    maps = torch.cat((crops.masks, crops.hidden), 1)
    for i in range(len(crops)):
        one = crops.rows(np.array([i]))
        xy, _ = one.project((flat @ poses.rotations[i].mT + poses.translations[i])[None])
        mask, hidden = one.sample(maps[i : i + 1], xy)[0].T
        inside = ((xy[0] >= 0) & (xy[0] < crops.size)).all(-1)
        mask = torch.where(inside, mask, 0.0)
        seen = 1 - torch.where(inside, hidden, 0.0)
        background += seen * (1 - mask).clamp(0, 1)
        known += seen
    empty = (background / known.clamp_min(1)).reshape(len(directions), SHELLS)
    # the share grows outwards; where it passes the limit is found between two shells
    empty = torch.cummax(empty, 1).values
    index = (empty < carved).sum(1).clamp(1, SHELLS - 1)
    rows = torch.arange(len(directions))
    low, high = empty[rows, index - 1], empty[rows, index]
    part = ((carved - low) / (high - low).clamp_min(1e-6)).clamp(0, 1)
    return steps[index - 1] + part * (steps[index] - steps[index - 1])


def with_samples(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "T 3"], count: int) -> Surface:
    """A mesh with points spread over it, by area."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = torch.linalg.cross(b - a, c - a).norm(dim=-1).numpy().astype(np.float64)
    rng = np.random.default_rng(0)
    # one of each equal share of the area: more even than independent draws
    cut = (np.arange(count) + rng.random(count)) / count * area.sum()
    chosen = np.searchsorted(np.cumsum(area), cut).clip(0, len(area) - 1)
    u, v = rng.random((2, count))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    weights = torch.from_numpy(np.stack((1 - u - v, u, v), -1)).float()
    pairs = torch.cat([faces[:, [i, (i + 1) % 3]] for i in range(3)])
    edges = torch.unique(pairs.sort(1).values, dim=0)
    return Surface(vertices, faces, faces[torch.from_numpy(chosen)], weights, edges)


def _sphere(divisions: int) -> tuple[Float[Tensor, "V 3"], Int[Tensor, "T 3"]]:
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=divisions)
    return (
        torch.from_numpy(np.array(mesh.vertices)).float(),
        torch.from_numpy(np.array(mesh.faces)).long(),
    )
