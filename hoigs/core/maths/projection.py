"""EWA projection of 3D Gaussians onto the image, and the drawing rules that every backend obeys.

EWA splatting (Zwicker et al. 2002) as in 3D Gaussian splatting (Kerbl et al. 2023,
arXiv:2308.04079); the clamp of the Jacobian is gsplat's (Ye et al. 2024, arXiv:2409.06765). All
backends agree exactly on the following.

**Projection.** R, t are of `camera.world_to_camera`; fx, fy, cx, cy of `camera.K`; W, H in pixels.

    (x, y, z) = R mean + t                                            camera space, metres
    u = fx x / z + cx + offset_u,   v = fy y / z + cy + offset_v      pixels ("means2d")
    tx = clamp(x / z, -(cx / fx + 0.3 hx), (W - cx) / fx + 0.3 hx)    hx = 0.5 W / fx
    ty = clamp(y / z, -(cy / fy + 0.3 hy), (H - cy) / fy + 0.3 hy)    hy = 0.5 H / fy
    A = R rotation(normalise(quat)) diag(exp(log_scales))             3x3, rows A0 A1 A2
    m0 = fx / z (A0 - tx A2),   m1 = fy / z (A1 - ty A2)              = J A, 2x3
    xx = m0.m0 + low_pass,  xy = m0.m1,  yy = m1.m1 + low_pass        screen covariance, square px
    det = |m0 x m1|^2 + low_pass (m0.m0 + m1.m1) + low_pass^2         = xx yy - xy^2, no cancelling
    conic = (yy, -xy, xx) / det                                       its inverse
    opacity = sigmoid(opacity_logit)                                  as in 3DGS, or, antialiased,
    opacity = sigmoid(opacity_logit) |m0 x m1| / sqrt(det)            Mip-Splatting's 2D filter

A camera with `optics` (fisheye, orthographic, distorted, rolling shutter) has means2d and the
screen covariance without low_pass by the unscented transform, see `hoigs.core.maths.optics`, in
float64; all that follows is the same.

With the principal point in the middle the clamp is 3DGS's 1.3 tan(fov / 2). It bounds only the
Jacobian, never (u, v), and its gradient is clamp's: none to x / z outside the limits.

**Colour.** max(c, 0), c = 0.5 + sum_k sh_k Y_k(d), d = normalise(mean - camera centre), where the
camera centre is -R^T t (see `hoigs.core.maths.spherical_harmonics`). Its gradient is that of c
where c >= -BLACK = -1e-6, else zero: black learns, also where rounding puts it below zero.

**Culling.** A row is not drawn, and every one of its gradients is zero, when
  - `subset` excludes it;
  - any of its raw fields (all of sh), features or screen_offsets is not finite, but for opacity
    logits of +infinity and -infinity: opacities of 1 and 0, with a gradient of zero;
  - |quat| is outside [1e-8, 1e8] (the zero quaternion);
  - z <= near, or one of |x|, |y|, z, the scales, |u| or |v| exceeds LIMIT = 1e10;
  - the camera has optics, by which one of its seven points has no place on the image;
  - not xx + yy <= MAX_VARIANCE = 1e12 (overflow), or not det >= MIN_DETERMINANT = 1e-12;
  - min_alpha > 0 and opacity < min_alpha;
  - min_alpha > 0 and its box misses the image: u + hu < 0, u - hu > W, v + hv < 0 or v - hv > H,
    where (hu, hv) = sqrt(reach xx), sqrt(reach yy) and reach = 2 ln(opacity / min_alpha).
The limits are numbers, not overflow of a dtype, so that float32 and float64 cull alike.

**Compositing.** At the pixel centre p = (column + 0.5, row + 0.5), with d = p - (u, v), over the
splats in order of z (ties: by index), starting from T = 1:

    alpha_i = min(max_alpha, opacity exp(-0.5 d^T conic d))           no gradient where clamped
    if alpha_i < min_alpha: skip splat i                              the only edge of a splat
    if min_transmittance > 0 and T (1 - alpha_i) <= min_transmittance: stop, without drawing i
    w_i = T alpha_i;   T = T (1 - alpha_i)

    alpha = sum w_i = 1 - T;   depth = sum w_i z_i;   features = sum w_i f_i
    color = sum w_i color_i + (1 - alpha) background

There is no 3-sigma edge, so the picture does not depend on tiles. `radii` = ceil(3 sqrt(largest
eigenvalue of the screen covariance)) is a report for density control only; 0 when culled.
In float32, d^T conic d of a long thin splat is best taken as the sum of two squares,
(dx - (xy / yy) dy)^2 yy / det + dy^2 / yy, which is the same number without cancelling.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from hoigs.core.maths.optics import Optics, unscented
from hoigs.core.maths.rotations import quats_to_matrices

LIMIT = 1e10  # metres or pixels; beyond this a row counts as not finite
MAX_VARIANCE = 1e12  # square pixels: a standard deviation of a million pixels
MIN_DETERMINANT = 1e-12
QUAT_NORMS = (1e-8, 1e8)


@dataclass(frozen=True)
class Projection:
    """The M rows that are drawn, on screen; in the order of the input, not of depth.

    Attributes:
        index: row of each in the input, ascending.
        means2d: centres (u, v), pixels, screen offsets included.
        depths: camera z, metres.
        covs: screen covariance (xx, xy, yy), low-pass included, square pixels.
        conics: inverse of `covs` (xx, xy, yy).
        opacities: in [0, 1], as they are composited.
        extents: half width and half height of the box where alpha >= min_alpha, pixels; infinite
            when min_alpha is 0. No gradient.
        radii: ceil(3 sigma) of the longest axis, pixels. No gradient.
    """

    index: Int[Tensor, " M"]
    means2d: Float[Tensor, "M 2"]
    depths: Float[Tensor, " M"]
    covs: Float[Tensor, "M 3"]
    conics: Float[Tensor, "M 3"]
    opacities: Float[Tensor, " M"]
    extents: Float[Tensor, "M 2"]
    radii: Float[Tensor, " M"]

    def __len__(self) -> int:
        return self.index.shape[0]


def project(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    log_scales: Float[Tensor, "N 3"],
    opacity_logits: Float[Tensor, " N"],
    world_to_camera: Float[Tensor, "4 4"],
    K: Float[Tensor, "3 3"],
    width: int,
    height: int,
    *,
    optics: Optics | None = None,
    screen_offsets: Float[Tensor, "N 2"] | None = None,
    drawable: Bool[Tensor, " N"] | None = None,
    near: float = 0.05,
    low_pass: float = 0.3,
    antialiased: bool = False,
    min_alpha: float = 1.0 / 255.0,
) -> Projection:
    """Project by the rules at the head of this module.

    Culled rows are left out before anything is differentiated, so that no NaN of theirs can enter
    a gradient. Gradients reach all floating-point tensors.

    Args:
        means, quats, log_scales, opacity_logits: raw space, world.
        world_to_camera, K, width, height: the camera; the tensors in the dtype of the means.
        optics: None for a pinhole with a global shutter, by EWA.
        screen_offsets: added to the projected means, pixels.
        drawable: rows that are not culled for other reasons than their geometry and opacity.
        near: metres. low_pass: square pixels. antialiased: opacities make up for `low_pass`.
        min_alpha: 0 means no cut-off.
    """
    dtype = means.dtype
    if optics is None:
        onto_screen: Callable[..., _OnScreen] = _onto_screen
        camera: tuple[Any, ...] = (world_to_camera, K, K.new_tensor([width, height]), low_pass)
    else:
        onto_screen = _through_optics
        means, quats, log_scales = (x.double() for x in (means, quats, log_scales))
        opacity_logits, world_to_camera, K = (
            x.double() for x in (opacity_logits, world_to_camera, K)
        )
        screen_offsets = None if screen_offsets is None else screen_offsets.double()
        camera = (*optics.middle(world_to_camera), K, (width, height), low_pass, optics, near)
    size = K.new_tensor([width, height])
    rows = (means, quats, log_scales, screen_offsets)
    with torch.no_grad():
        keep = torch.stack([torch.isfinite(x).all(-1) for x in rows if x is not None]).all(0)
        keep &= ~opacity_logits.isnan()
        if drawable is not None:
            keep &= drawable
        norms = quats.norm(dim=-1)
        keep &= (norms >= QUAT_NORMS[0]) & (norms <= QUAT_NORMS[1])
        keep &= (log_scales.exp() <= LIMIT).all(-1)
        cam, means2d, covs, area, det, seen = onto_screen(
            means, quats, log_scales, screen_offsets, *camera
        )
        keep &= seen
        keep &= (cam[:, 2] > near) & (cam.abs() <= LIMIT).all(-1)
        keep &= (means2d.abs() <= LIMIT).all(-1)
        keep &= (covs[:, 0] + covs[:, 2] <= MAX_VARIANCE) & (det >= MIN_DETERMINANT)
        if min_alpha > 0:
            opacities = torch.sigmoid(opacity_logits)
            if antialiased:
                opacities = opacities * area / det.sqrt()
            extents = _extents(covs, opacities, min_alpha)
            keep &= opacities >= min_alpha
            keep &= ((means2d + extents >= 0) & (means2d - extents <= size)).all(-1)
        index = keep.nonzero().squeeze(1)
    offsets = screen_offsets if screen_offsets is None else screen_offsets[index]
    cam, means2d, covs, area, det, _ = onto_screen(
        means[index], quats[index], log_scales[index], offsets, *camera
    )
    opacities = torch.sigmoid(opacity_logits[index])
    if antialiased:
        opacities = opacities * area / det.sqrt()
    xx, xy, yy = covs.unbind(-1)
    conics = torch.stack((yy, -xy, xx), -1) / det[:, None]
    with torch.no_grad():
        largest = 0.5 * (xx + yy) + (0.25 * (xx - yy).square() + xy.square()).sqrt()
        radii = (3.0 * largest.sqrt()).ceil()
        extents = _extents(covs, opacities, min_alpha)
    found = (means2d, cam[:, 2], covs, conics, opacities, extents, radii)
    return Projection(index, *(x.to(dtype) for x in found))


# Camera-space centres [M, 3], pixel centres [M, 2], screen covariances [M, 3] (xx, xy, yy), area
# before the low-pass [M], det [M], and which rows have a place on the image [M].
_OnScreen = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]


def _onto_screen(
    means: Float[Tensor, "M 3"],
    quats: Float[Tensor, "M 4"],
    log_scales: Float[Tensor, "M 3"],
    offsets: Float[Tensor, "M 2"] | None,
    world_to_camera: Float[Tensor, "4 4"],
    K: Float[Tensor, "3 3"],
    size: Float[Tensor, " 2"],
    low_pass: float,
) -> _OnScreen:
    """By EWA, through a pinhole; all rows have a place, those behind the camera too."""
    rotation = world_to_camera[:3, :3]
    cam = means @ rotation.mT + world_to_camera[:3, 3]
    inverse_z = 1.0 / cam[:, 2]
    slopes = cam[:, :2] * inverse_z[:, None]
    focal, principal = torch.stack((K[0, 0], K[1, 1])), K[:2, 2]
    means2d = focal * slopes + principal
    if offsets is not None:
        means2d = means2d + offsets

    margin = 0.3 * 0.5 * size / focal
    low, high = -(principal / focal + margin), (size - principal) / focal + margin
    slopes = torch.minimum(torch.maximum(slopes, low), high)
    axes = rotation @ quats_to_matrices(quats) * log_scales.exp()[:, None, :]
    m = (focal * inverse_z[:, None])[..., None] * (axes[:, :2] - slopes[..., None] * axes[:, 2:])
    area = torch.linalg.vector_norm(torch.linalg.cross(*m.unbind(1)), dim=-1)
    covs, det = _blurred(m, area, low_pass)
    return cam, means2d, covs, area, det, torch.ones_like(det, dtype=torch.bool)


def _through_optics(
    means: Float[Tensor, "M 3"],
    quats: Float[Tensor, "M 4"],
    log_scales: Float[Tensor, "M 3"],
    offsets: Float[Tensor, "M 2"] | None,
    world_to_camera: Float[Tensor, "4 4"],
    motion: Float[Tensor, " 6"] | None,
    K: Float[Tensor, "3 3"],
    size: tuple[int, int],
    low_pass: float,
    optics: Optics,
    near: float,
) -> _OnScreen:
    """By the unscented transform; the pose is that in the middle of the exposure."""
    cam = means @ world_to_camera[:3, :3].mT + world_to_camera[:3, 3]
    axes = quats_to_matrices(quats) * log_scales.exp()[:, None, :]
    means2d, root, seen = unscented(means, axes, world_to_camera, motion, K, size, optics, near)
    if offsets is not None:
        means2d = means2d + offsets
    m0, m1 = root.unbind(1)
    i, j = torch.triu_indices(7, 7, 1, device=means.device)
    area = torch.linalg.vector_norm(m0[:, i] * m1[:, j] - m0[:, j] * m1[:, i], dim=-1)
    covs, det = _blurred(root, area, low_pass)
    return cam, means2d, covs, area, det, seen


def _blurred(
    root: Float[Tensor, "M 2 R"], area: Float[Tensor, " M"], low_pass: float
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, " M"]]:
    """Screen covariances (xx, xy, yy) with the low-pass, and their determinants; square pixels.

    Args:
        root: rows m0, m1 of a square root of the covariances. area: sqrt(xx yy - xy^2) of these,
            by Lagrange's identity the length of all 2x2 minors of the root.
    """
    m0, m1 = root.unbind(1)
    xx, xy, yy = (m0 * m0).sum(-1), (m0 * m1).sum(-1), (m1 * m1).sum(-1)
    det = area.square() + low_pass * (xx + yy) + low_pass * low_pass
    return torch.stack((xx + low_pass, xy, yy + low_pass), -1), det


def _extents(
    covs: Float[Tensor, "M 3"], opacities: Float[Tensor, " M"], min_alpha: float
) -> Float[Tensor, "M 2"]:
    """Half width and height, pixels, of the ellipse where opacity exp(-q / 2) >= min_alpha."""
    if min_alpha <= 0:
        return torch.full_like(covs[:, :2], torch.inf)
    reach = 2.0 * (opacities / min_alpha).log()
    return (reach[:, None] * covs[:, ::2]).sqrt()
