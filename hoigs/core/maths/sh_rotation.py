"""Spherical-harmonics colours of a world that is rotated."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.maths.spherical_harmonics import sh_basis


def rotate_sh(sh: Float[Tensor, "N K 3"], rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "N K 3"]:
    """Coefficients whose colour in direction R d is that of `sh` in direction d.

    Each band is closed under rotation, so its matrix follows exactly from as many directions as it
    has functions; more are used, in float64 (the matrices of Ivanic & Ruedenberg 1996).

    Args:
        sh: of degree 0 to 3. rotation: R, of the world.
    """
    bands = sh.shape[1]
    degree = int(bands**0.5 + 0.5) - 1
    directions = torch.nn.functional.normalize(_directions(4 * bands), dim=-1)
    turned = directions @ rotation.double().cpu().mT  # R d
    matrix = torch.linalg.lstsq(sh_basis(turned, degree), sh_basis(directions, degree)).solution
    return torch.einsum("jk,nkc->njc", matrix.to(sh), sh)


def _directions(count: int) -> Float[Tensor, "D 3"]:
    """Points spread evenly over the sphere (the Fibonacci lattice)."""
    place = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * place / count
    turn = torch.pi * (1 + 5**0.5) * place
    ring = (1 - z * z).sqrt()
    return torch.stack((ring * turn.cos(), ring * turn.sin(), z), -1)
