"""How rough attributes are over a body's surface: L_reg of HOIGS, Eq. 16, as ExAvatar has it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hoigs.core.cpu_kernels.choose import native
from hoigs.core.maths.nearest import nearest
from hoigs.plugins.deformation.avatars.canonical_head import CanonicalAttributes

LaplacianOn = Literal["points", "mesh"]
Smoothed = Literal["offset", "scale", "color"]


def neighbours_of(points: Float[Tensor, "N 3"], count: int = 4) -> Int[Tensor, "N k"] | None:
    """Indices of each point's nearest neighbours, or None if there are too few points."""
    return nearest(points, count)[0] if len(points) > count else None


def point_roughness(
    values: Float[Tensor, "N D"], neighbours: Int[Tensor, "N k"]
) -> Float[Tensor, ""]:
    """Mean over points of |x_i - mean of its neighbours' x|^2."""
    kernels = native("roughness", values)
    if kernels is not None:
        fast: Tensor = kernels.Roughness.apply(values, neighbours)
        return fast
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
    degree = values.new_zeros(len(values)).index_add(0, edges[:, 0], values.new_ones(len(edges)))
    sums = torch.zeros_like(values).index_add(0, edges[:, 0], values[edges[:, 1]])
    means = torch.where(degree[:, None] > 0, sums / degree.clamp_min(1)[:, None], values)
    return (values - means).square().sum(-1).mean()


def laplacians(
    attributes: CanonicalAttributes,
    smoothed: Sequence[Smoothed],
    neighbours: Int[Tensor, "N k"] | None,
    edges: Int[Tensor, "E 2"] | None,
) -> dict[str, Tensor]:
    """The penalties "laplacian" (of offsets), "laplacian_scale", "laplacian_color", by `smoothed`.

    Args:
        attributes: of the vertices if there are edges, else of the points that have neighbours.
    """
    choices = {
        "offset": ("laplacian", attributes.offsets),
        "scale": ("laplacian_scale", attributes.log_scales),
        "color": ("laplacian_color", attributes.colors),
    }
    penalties = {}
    for name, values in (choices[what] for what in smoothed):
        if edges is not None:
            penalties[name] = mesh_roughness(values, edges)
        elif neighbours is not None:
            penalties[name] = point_roughness(values, neighbours)
    return penalties
