"""Light by the direction in which a surface faces, for entities that turn under it."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import pad

from hoigs.core.maths.rotations import (
    conjugate_quats,
    multiply_quats,
    normalize_quats,
    quats_to_matrices,
)
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
        return moved.replace(sh=moved.sh + gain[:, None] * above_black(moved.sh))


def irradiance_basis(normals: Float[Tensor, "N 3"]) -> Float[Tensor, "N 8"]:
    """Real spherical harmonics of degrees 1 and 2 at unit vectors, without their constants."""
    x, y, z = normals.unbind(-1)
    return torch.stack((x, y, z, x * y, y * z, z * x, x * x - y * y, 3 * z * z - 1), -1)


def above_black(sh: Float[Tensor, "N B 3"]) -> Float[Tensor, "N B 3"]:
    """SH coefficients of the colours themselves: those of Gaussians are relative to 0.5."""
    grey = sh.new_full((1, 1, 3), 0.5 / SH_C0)
    return sh + pad(grey, (0, 0, 0, sh.shape[1] - 1))


def turned_normals(
    normals: Float[Tensor, "N 3"], before: Float[Tensor, "N 4"], after: Float[Tensor, "N 4"]
) -> Float[Tensor, "N 3"]:
    """Normals turned as Gaussians are from rotation `before` to `after`, wxyz of any length."""
    turns = normalize_quats(multiply_quats(after, conjugate_quats(before)))
    w, axes = turns[:, :1], turns[:, 1:]
    swept = 2 * torch.linalg.cross(axes, normals)
    return normals + w * swept + torch.linalg.cross(axes, swept)


def outward_normals(still: Gaussians) -> Float[Tensor, "N 3"]:
    """Normals of flat Gaussians, their z axes, each away from the centre of all of them."""
    normals = quats_to_matrices(still.quats)[:, :, 2]
    outward = (normals * (still.means - still.means.mean(0))).sum(-1, keepdim=True)
    return torch.where(outward < 0, -normals, normals)
