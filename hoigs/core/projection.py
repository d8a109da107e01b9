"""EWA projection of 3D Gaussians onto the image, and the drawing rules that every backend obeys.

Zwicker et al., "EWA Splatting", 2002; Kerbl et al., "3D Gaussian Splatting", 2023; the clamp of the
Jacobian is gsplat's (Ye et al. 2024). All backends agree on the following, exactly.

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
    opacity = sigmoid(opacity_logit)                                  not compensated for low_pass

With the principal point in the middle the clamp is 3DGS's 1.3 tan(fov / 2). It bounds only the
Jacobian, never (u, v), and its gradient is clamp's: none to x / z outside the limits.

**Colour.** max(0.5 + sum_k sh_k Y_k(d), 0), d = normalise(mean - camera centre), where the camera
centre is -R^T t (see `hoigs.core.harmonics`).

**Culling.** A row is not drawn, and every one of its gradients is zero, when
  - `subset` excludes it;
  - any of its raw fields (all of sh), features or screen_offsets is not finite;
  - |quat| is outside [1e-8, 1e8] (the zero quaternion);
  - z <= near, or one of |x|, |y|, z, the scales, |u| or |v| exceeds LIMIT = 1e10;
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

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hoigs.core.camera import Camera
from hoigs.core.gaussians import Gaussians
from hoigs.core.rasterizer import RenderRequest
from hoigs.core.rotation import quats_to_matrices

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
        opacities: in (0, 1).
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


def project(gaussians: Gaussians, camera: Camera, request: RenderRequest) -> Projection:
    """Project by the rules at the head of this module, in the dtype of the Gaussians.

    Culled rows are left out before anything is differentiated, so that no NaN of theirs can enter
    a gradient. Gradients reach the means, quats, log_scales, opacity_logits, screen offsets, K and
    world_to_camera.

    Args:
        gaussians: raw space, world, N rows.
        camera: on the same device; converted to their dtype.
        request: features, subset, screen_offsets, near, low_pass and min_alpha are read.
    """
    camera = camera.to(gaussians.means.dtype)
    offsets = request.screen_offsets
    if offsets is not None:
        offsets = offsets.to(gaussians.means.dtype)
    with torch.no_grad():
        index = _visible(gaussians, offsets, camera, request).nonzero().squeeze(1)
    rows, offsets = gaussians[index], offsets if offsets is None else offsets[index]
    cam, means2d, covs, det = _onto_screen(rows, offsets, camera, request.low_pass)
    opacities = rows.opacities
    xx, xy, yy = covs.unbind(-1)
    conics = torch.stack((yy, -xy, xx), -1) / det[:, None]
    with torch.no_grad():
        largest = 0.5 * (xx + yy) + (0.25 * (xx - yy).square() + xy.square()).sqrt()
        radii = (3.0 * largest.sqrt()).ceil()
        extents = _extents(covs, opacities, request.min_alpha)
    return Projection(index, means2d, cam[:, 2], covs, conics, opacities, extents, radii)


def _onto_screen(
    rows: Gaussians, offsets: Float[Tensor, "M 2"] | None, camera: Camera, low_pass: float
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M 2"], Float[Tensor, "M 3"], Float[Tensor, " M"]]:
    """Camera-space centres, pixel centres, screen covariances (xx, xy, yy) and determinants."""
    cam = camera.to_camera(rows.means)
    inverse_z = 1.0 / cam[:, 2]
    slopes = cam[:, :2] * inverse_z[:, None]
    focal = torch.stack((camera.K[0, 0], camera.K[1, 1]))
    principal = camera.K[:2, 2]
    size = focal.new_tensor([camera.width, camera.height])
    means2d = focal * slopes + principal
    if offsets is not None:
        means2d = means2d + offsets

    margin = 0.3 * 0.5 * size / focal
    low, high = -(principal / focal + margin), (size - principal) / focal + margin
    slopes = torch.minimum(torch.maximum(slopes, low), high)
    axes = camera.world_to_camera[:3, :3] @ quats_to_matrices(rows.quats) * rows.scales[:, None, :]
    m = (focal * inverse_z[:, None])[..., None] * (axes[:, :2] - slopes[..., None] * axes[:, 2:])
    m0, m1 = m.unbind(1)
    xx, xy, yy = (m0 * m0).sum(-1), (m0 * m1).sum(-1), (m1 * m1).sum(-1)
    area = torch.linalg.cross(m0, m1).square().sum(-1)  # xx yy - xy^2, by Lagrange's identity
    det = area + low_pass * (xx + yy) + low_pass * low_pass
    return cam, means2d, torch.stack((xx + low_pass, xy, yy + low_pass), -1), det


def _visible(
    rows: Gaussians, offsets: Float[Tensor, "M 2"] | None, camera: Camera, request: RenderRequest
) -> Tensor:
    """Boolean mask [M] of the rows that pass every culling rule. Comparisons with NaN are false."""
    values = [rows.means, rows.quats, rows.log_scales, rows.opacity_logits[:, None]]
    values += [rows.sh.flatten(1)]
    values += [x for x in (request.features, offsets) if x is not None]
    keep = torch.stack([torch.isfinite(x).all(-1) for x in values]).all(0)
    if request.subset is not None:
        keep &= request.subset
    norms = rows.quats.norm(dim=-1)
    keep &= (norms >= QUAT_NORMS[0]) & (norms <= QUAT_NORMS[1])
    keep &= (rows.scales <= LIMIT).all(-1)

    cam, means2d, covs, det = _onto_screen(rows, offsets, camera, request.low_pass)
    keep &= (cam[:, 2] > request.near) & (cam.abs() <= LIMIT).all(-1)
    keep &= (means2d.abs() <= LIMIT).all(-1)
    keep &= (covs[:, 0] + covs[:, 2] <= MAX_VARIANCE) & (det >= MIN_DETERMINANT)
    if request.min_alpha > 0:
        opacities = rows.opacities
        extents = _extents(covs, opacities, request.min_alpha)
        size = means2d.new_tensor([camera.width, camera.height])
        keep &= opacities >= request.min_alpha
        keep &= ((means2d + extents >= 0) & (means2d - extents <= size)).all(-1)
    return keep


def _extents(
    covs: Float[Tensor, "M 3"], opacities: Float[Tensor, " M"], min_alpha: float
) -> Float[Tensor, "M 2"]:
    """Half width and height, pixels, of the ellipse where opacity exp(-q / 2) >= min_alpha."""
    if min_alpha <= 0:
        return torch.full_like(covs[:, :2], torch.inf)
    reach = 2.0 * (opacities / min_alpha).log()
    return (reach[:, None] * covs[:, ::2]).sqrt()
