"""How rough something is over a body's surface: the paper's L_reg (ExAvatar, Moon et al. 2024)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hoigs.plugins.deformation.canonical_head import CanonicalAttributes

LaplacianOn = Literal["points", "mesh"]
Smoothed = Literal["offset", "scale", "color"]


def nearest(points: Float[Tensor, "N 3"], count: int = 4) -> Int[Tensor, "N k"] | None:
    """Indices of each point's nearest neighbours, or None when there are too few points."""
    from scipy.spatial import cKDTree  # on use: scipy takes a while to import

    if len(points) <= count:
        return None
    array = points.cpu().double().numpy()
    _, indices = cKDTree(array).query(array, k=count + 1)
    return torch.as_tensor(indices[:, 1:], dtype=torch.int64, device=points.device)


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
    """Mean over vertices of |x_v - mean over its edges' other ends|^2: the uniform Laplacian.

    Vertices without an edge count as smooth.

    Args:
        edges: `mesh_edges` of the mesh.
    """
    # not bincount, which waits for a device to know how many bins there are
    degree = values.new_zeros(len(values)).index_add(0, edges[:, 0], values.new_ones(len(edges)))
    sums = torch.zeros_like(values).index_add(0, edges[:, 0], values[edges[:, 1]])
    means = torch.where(degree[:, None] > 0, sums / degree.clamp_min(1)[:, None], values)
    return (values - means).square().sum(-1).mean()


def laplacians(
    said: CanonicalAttributes,
    smoothed: Sequence[Smoothed],
    neighbours: Int[Tensor, "N k"] | None,
    edges: Int[Tensor, "E 2"] | None,
) -> dict[str, Tensor]:
    """The penalties "laplacian" (of offsets), "laplacian_scale", "laplacian_color", if asked for.

    Args:
        said: psi_h, at the vertices if there are edges, else at the points that neighbours index.
    """
    choices = {
        "offset": ("laplacian", said.offsets),
        "scale": ("laplacian_scale", said.log_scales),
        "color": ("laplacian_color", said.colors),
    }
    penalties = {}
    for name, values in (choices[what] for what in smoothed):
        if edges is not None:
            penalties[name] = mesh_roughness(values, edges)
        elif neighbours is not None:
            penalties[name] = point_roughness(values, neighbours)
    return penalties
