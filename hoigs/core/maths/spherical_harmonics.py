"""Real spherical harmonics of degree 0 to 4 for view-dependent colour."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.device import replaceable

C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (
    0.5900435899266435,
    2.890611442640554,
    0.4570457994644658,
    0.3731763325901154,
    1.445305721320277,
)
C4 = (
    2.5033429417967046,
    1.7701307697799304,
    0.9461746957575601,
    0.6690465435572892,
    0.10578554691520431,
    0.47308734787878004,
    0.6258357354491761,
)
BLACK = 1e-6  # a colour as little below zero is zero but for rounding


def sh_basis(directions: Float[Tensor, "*batch 3"], degree: int) -> Float[Tensor, "*batch K"]:
    """The first K = (degree + 1)^2 basis functions at unit directions.

    Order and signs are those of 3DGS and gsplat (Kerbl et al. 2023; Sloan 2008), so that their
    checkpoints can be read: degree 1 is (-y, z, -x).

    Args:
        directions: unit vectors (x, y, z).
        degree: 0 to 4; rasterizers draw up to 3.

    Raises:
        ValueError: another degree.
    """
    if not 0 <= degree <= 4:
        raise ValueError(f"spherical harmonics of degree {degree}: expected 0 to 4")
    x, y, z = directions.unbind(-1)
    bands = [torch.full_like(x, C0)]
    if degree >= 1:
        bands += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        bands += [
            C2[0] * x * y,
            -C2[0] * y * z,
            C2[1] * (2 * zz - xx - yy),
            -C2[0] * x * z,
            C2[2] * (xx - yy),
        ]
    if degree >= 3:
        bands += [
            -C3[0] * y * (3 * xx - yy),
            C3[1] * x * y * z,
            -C3[2] * y * (4 * zz - xx - yy),
            C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            -C3[2] * x * (4 * zz - xx - yy),
            C3[4] * z * (xx - yy),
            -C3[0] * x * (xx - 3 * yy),
        ]
    if degree >= 4:
        bands += [
            C4[0] * x * y * (xx - yy),
            -C4[1] * y * z * (3 * xx - yy),
            C4[2] * x * y * (7 * zz - 1),
            -C4[3] * y * z * (7 * zz - 3),
            C4[4] * (zz * (35 * zz - 30) + 3),
            -C4[3] * x * z * (7 * zz - 3),
            C4[5] * (xx - yy) * (7 * zz - 1),
            -C4[1] * x * z * (xx - 3 * yy),
            C4[6] * (xx * (xx - 3 * yy) - yy * (3 * xx - yy)),
        ]
    return torch.stack(bands, dim=-1)


@replaceable
def irradiance_basis(normals: Float[Tensor, "N 3"]) -> Float[Tensor, "N 8"]:
    """Real spherical harmonics of degrees 1 and 2 at unit vectors, without their constants."""
    x, y, z = normals.unbind(-1)
    second = (x * y, y * z, z * x, x**2 - y**2, 2 * z**2 - x**2 - y**2)
    return torch.cat((normals, torch.stack(second, -1)), -1)


def mean_colors(
    sh: Float[Tensor, "N K 3"],
    means: Float[Tensor, "N 3"],
    camera_centers: Sequence[Float[Tensor, " 3"]],
) -> Float[Tensor, "N 3"]:
    """Colours for where none may depend on the direction: the mean of what cameras see, >= 0.

    Band 0 alone is the mean over all directions, most of which no camera looks along; after
    training from one video the two differ a lot.
    """
    seen = [sh_to_colors(sh, means, center.to(means)) for center in camera_centers]
    return torch.stack(seen).mean(0)


def sh_to_colors(
    sh: Float[Tensor, "N K 3"],
    means: Float[Tensor, "N 3"],
    camera_center: Float[Tensor, " 3"],
    degree: int | None = None,
) -> Float[Tensor, "N 3"]:
    """Colours of Gaussians seen from a point: max(0.5 + sum_k sh_k Y_k(d), 0).

    d = normalise(mean - camera_center). Gradients reach the coefficients and, through d, the means
    and the camera, as `not_negative` passes them.

    Args:
        sh: raw coefficients, K = (stored degree + 1)^2.
        means: centres, world, metres.
        camera_center: metres, world.
        degree: highest band to use; None, or more than is stored, is all that are stored.
    """
    stored = int(sh.shape[1] ** 0.5 + 0.5) - 1
    active = stored if degree is None else min(degree, stored)
    if active == 0:  # constant colour: no direction, so no gradient to means or camera
        return not_negative(0.5 + C0 * sh[:, 0])
    directions = torch.nn.functional.normalize(means - camera_center, dim=-1)
    basis = sh_basis(directions, active)
    return not_negative(0.5 + torch.einsum("nk,nkc->nc", basis, sh[:, : basis.shape[1]]))


def not_negative(colors: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """max(c, 0), with the gradient of c where c >= -BLACK, else none.

    The coefficients of black give a c on either side of zero, as sums are ordered and products
    fused into them; black must learn all the same.
    """
    raised = (colors.clamp_min(0.0) - colors).detach()
    return torch.where(colors >= -BLACK, colors + raised, 0.0)


def rotate_sh(sh: Float[Tensor, "N K 3"], rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "N K 3"]:
    """Coefficients whose colour in direction R d is that of `sh` in direction d.

    Each band is closed under rotation, so its matrix follows exactly from as many directions as it
    has functions; more are used, in float64 (the matrices of Ivanic & Ruedenberg 1996).

    Args:
        sh: coefficients of degree 0 to 3. rotation: rotation R of the world.
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
