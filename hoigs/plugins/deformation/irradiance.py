"""Light by the direction in which a surface faces, for entities that turn under it."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.device import constant
from hoigs.core.maths.nearest import surface_normals
from hoigs.core.maths.rotations import quats_to_matrices, relative_quats
from hoigs.core.maths.spherical_harmonics import irradiance_basis
from hoigs.core.values.gaussians import SH_C0, Gaussians

TERMS = 8  # spherical harmonics of degrees 1 and 2


class Irradiance(nn.Module):
    """c' = (1 + sum_k l_k Y_k(n)) c: colours of an entity whose normals n turn under a fixed light.

    The light that a matte surface receives from far away depends on its normal alone, and
    spherical harmonics up to degree 2 hold 98 % of it (Ramamoorthi and Hanrahan 2001, "An efficient
    representation for irradiance environment maps"). Degree 0 is the colours' own. One `light` [8,
    3], for all Gaussians and all times, so that what a face looks like when it turns towards the
    lamp is learned from other faces too. Shadows are not in it. It starts at no change.
    """

    def __init__(self) -> None:
        super().__init__()
        self.light = nn.Parameter(torch.zeros(TERMS, 3))

    def forward(self, moved: Gaussians, normals: Float[Tensor, "N 3"]) -> Gaussians:
        """
        Args:
            moved: raw Gaussians. normals: in the world, unit, pointing outwards.
        """
        gain = irradiance_basis(normals) @ self.light
        colors = moved.sh + mid_grey(moved.sh)
        return moved.replace(sh=torch.addcmul(moved.sh, gain[:, None], colors))


def mid_grey(sh: Float[Tensor, "N B 3"]) -> Float[Tensor, "B 1"]:
    """SH coefficients of the colour 0.5, to which those of Gaussians are relative."""
    return constant(((0.5 / SH_C0,), *((0.0,),) * (sh.shape[1] - 1)), sh)


def turned_normals(
    normals: Float[Tensor, "N 3"], before: Float[Tensor, "N 4"], after: Float[Tensor, "N 4"]
) -> Float[Tensor, "N 3"]:
    """Normals turned as Gaussians are from rotation `before` to `after`, wxyz of any length."""
    turns = quats_to_matrices(relative_quats(after, before))
    return (turns @ normals[..., None]).squeeze(-1)


def outward_normals(still: Gaussians) -> Float[Tensor, "N 3"]:
    """Normals of a surface of Gaussians, each away from the centre of all of them.

    Flat ones have it along z (`Gaussians.from_points`); of isotropic ones it is that of the plane
    through their neighbours.
    """
    normals = quats_to_matrices(still.quats)[:, :, 2]
    flat = still.log_scales[:, 2:] < still.log_scales[:, :2].amin(1, keepdim=True)
    if not flat.all():
        normals = torch.where(flat, normals, surface_normals(still.means))
    outward = (normals * (still.means - still.means.mean(0))).sum(-1, keepdim=True)
    return torch.where(outward < 0, -normals, normals)
