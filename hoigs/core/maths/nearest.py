"""The nearest neighbours of points, their surface, and how rough values are over it."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from hoigs.core.device import replaceable
from hoigs.core.maths.rows import added_rows, rows_of


def nearest(
    points: Float[Tensor, "N 3"], count: int, among: Float[Tensor, "M 3"] | None = None
) -> tuple[Int[Tensor, "N k"], Float[Tensor, "N k"]]:
    """Indices and float64 distances of each point's nearest neighbours, nearest first.

    Args:
        count: k; it is less if there are fewer neighbours.
        among: where the neighbours are searched; by default the other points.
    """
    from scipy.spatial import cKDTree  # on use: scipy takes a while to import

    itself = among is None
    others = _array(points if among is None else among)
    ranks = np.arange(1, min(count, len(others) - itself) + 1) + itself
    if len(ranks) == 0:
        empty = torch.zeros(len(points), 0, dtype=torch.float64, device=points.device)
        return empty.long(), empty
    distances, indices = cKDTree(others).query(_array(points), k=ranks)
    return (
        torch.as_tensor(indices, dtype=torch.int64, device=points.device),
        torch.as_tensor(distances, device=points.device),
    )


def surface_normals(points: Float[Tensor, "N 3"], neighbours: int = 12) -> Float[Tensor, "N 3"]:
    """Unit normals, of either sign, of the planes through each point and its nearest neighbours.

    The direction of least variance (Hoppe et al. 1992). It is any direction for fewer than three
    points, or where they lie on a line.
    """
    if len(points) < 3:
        return points.new_tensor([0.0, 0.0, 1.0]).repeat(len(points), 1)
    near = points[nearest(points, min(neighbours, len(points) - 1))[0]]
    around = torch.cat((points[:, None], near), 1)
    around = (around - around.mean(1, keepdim=True)).double()
    return torch.linalg.eigh(around.mT @ around)[1][..., 0].to(points)


def _array(points: Float[Tensor, "N 3"]) -> np.ndarray:
    return points.detach().cpu().double().numpy()


# More points on the surface that some points lie on.


NEIGHBOURS = 6
LEAST = 8  # points; fewer say little of a surface


def denser(
    points: Float[Tensor, "N 3"], colors: Float[Tensor, "N 3"], count: int, seed: int
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M 3"]]:
    """The points, followed by new ones up to `count`, each between a point and a neighbour of it.

    Colours are blended, too. Points that are `count` or more, or fewer than LEAST, stay as they
    are.
    """
    generator = torch.Generator().manual_seed(seed)
    while LEAST <= len(points) < count:
        rows, _ = nearest(points, NEIGHBOURS)
        pick = torch.randint(NEIGHBOURS, (len(points), 1), generator=generator)
        share = 0.3 + 0.4 * torch.rand(len(points), 1, generator=generator)
        other = rows.cpu().gather(1, pick)[:, 0].to(points.device)
        chosen = torch.randperm(len(points), generator=generator)[: count - len(points)]
        chosen, share = chosen.to(points.device), share.to(points)
        between = [torch.lerp(x, x[other], share)[chosen] for x in (points, colors)]
        points, colors = (
            torch.cat((old, new)) for old, new in zip((points, colors), between, strict=True)
        )
    return points, colors


# How rough values are over a surface: the Laplacian of L_reg (HOIGS, Eq. 16), as ExAvatar has it.


def neighbours_of(points: Float[Tensor, "N 3"], count: int = 4) -> Int[Tensor, "N k"] | None:
    """Indices of each point's nearest neighbours, or None if there are too few points."""
    return nearest(points, count)[0] if len(points) > count else None


@replaceable
def point_roughness(
    values: Float[Tensor, "N D"], neighbours: Int[Tensor, "N k"]
) -> Float[Tensor, ""]:
    """Mean over points of |x_i - mean of its neighbours' x|^2."""
    return (values - values[neighbours].mean(1)).square().sum(-1).mean()


def mesh_edges(faces: Int[Tensor, "F 3"]) -> Int[Tensor, "E 2"]:
    """Every edge of a mesh once in each direction."""
    pairs = torch.cat((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]))
    return torch.unique(torch.cat((pairs, pairs.flip(1))), dim=0)


def mesh_roughness(values: Float[Tensor, "V D"], edges: Int[Tensor, "E 2"]) -> Float[Tensor, ""]:
    """Mean over vertices of |x_v - mean of the vertices that share an edge with v|^2.

    This is the uniform Laplacian. Vertices without an edge count as smooth.

    Args:
        edges: `mesh_edges` of the mesh.
    """
    # not bincount, which waits for the device to report how many bins there are
    one, other = edges.unbind(1)
    degree = added_rows(values.new_ones(len(edges)), one, len(values))
    sums = added_rows(rows_of(values, other), one, len(values))
    means = torch.where(degree[:, None] > 0, sums / degree.clamp_min(1)[:, None], values)
    return (values - means).square().sum(-1).mean()
