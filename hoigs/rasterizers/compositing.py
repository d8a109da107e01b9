"""What the torch backends share: projection, splats in depth order, and their blending at pixels.

The rules are those at the head of `hoigs.core.maths.projection`.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from hoigs.core.interfaces.rasterizer import RenderOutput, RenderRequest
from hoigs.core.maths.projection import Projection, project
from hoigs.core.maths.spherical_harmonics import sh_to_colors
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians

CHUNK = 1 << 21  # pixels times splats blended at once: bounds the memory, forward and backward


@dataclass(frozen=True)
class Splats:
    """M visible Gaussians on screen, nearest first.

    Attributes:
        means2d: centres, pixels. covs, conics: (xx, xy, yy), as `Projection` has them.
        opacities: activated. extents: half sizes of the box where alpha >= min_alpha, pixels.
        channels: what is composited: RGB, depth, then the features; C = 4 + F.
        absolutes: receives the absolute gradients (A = 2), or empty where not requested (A = 0).
    """

    means2d: Float[Tensor, "M 2"]
    covs: Float[Tensor, "M 3"]
    conics: Float[Tensor, "M 3"]
    opacities: Float[Tensor, " M"]
    extents: Float[Tensor, "M 2"]
    channels: Float[Tensor, "M C"]
    absolutes: Float[Tensor, "M A"]

    def __len__(self) -> int:
        return self.means2d.shape[0]

    def __getitem__(self, index: Int[Tensor, " S"]) -> Splats:
        return Splats(*(getattr(self, f.name)[index] for f in fields(self)))

    def split(self, counts: list[int]) -> list[Splats]:
        """Consecutive parts of these lengths."""
        columns = (getattr(self, f.name).split(counts) for f in fields(self))
        return [Splats(*part) for part in zip(*columns)]


def project_gaussians(gaussians: Gaussians, camera: Camera, request: RenderRequest) -> Projection:
    """The rows that a request draws, on screen, in the dtype of the Gaussians."""
    dtype = gaussians.means.dtype
    camera, offsets = camera.to(dtype), request.screen_offsets
    drawable = torch.isfinite(gaussians.sh).flatten(1).all(-1)
    if request.features is not None:
        drawable &= torch.isfinite(request.features).all(-1)
    if request.subset is not None:
        drawable &= request.subset
    return project(
        gaussians.means,
        gaussians.quats,
        gaussians.log_scales,
        gaussians.opacity_logits,
        camera.world_to_camera,
        camera.K,
        camera.width,
        camera.height,
        optics=camera.optics,
        screen_offsets=None if offsets is None else offsets.to(dtype),
        drawable=drawable,
        near=request.near,
        low_pass=request.low_pass,
        antialiased=request.antialiased,
        min_alpha=request.min_alpha,
    )


def prepare(
    gaussians: Gaussians, camera: Camera, request: RenderRequest
) -> tuple[Splats, dict[str, Any]]:
    """Project, colour and sort by depth; also the `info` of the output, in the input's order."""
    camera = camera.to(gaussians.means.dtype)
    shown = project_gaussians(gaussians, camera, request)
    colors = sh_to_colors(
        gaussians.sh[shown.index], gaussians.means[shown.index], camera.middle.center,
        request.sh_degree,
    )  # fmt: skip
    channels = [colors, shown.depths[:, None]]
    if request.features is not None:
        channels.append(request.features[shown.index].to(colors.dtype))
    absolutes = colors.new_empty(len(shown), 0)
    if request.absolute_gradients is not None:
        absolutes = request.absolute_gradients[shown.index].to(colors.dtype)
    splats = Splats(
        shown.means2d,
        shown.covs,
        shown.conics,
        shown.opacities,
        shown.extents,
        torch.cat(channels, dim=-1),
        absolutes,
    )

    def scattered(values: Tensor) -> Tensor:
        full = values.new_zeros(len(gaussians), *values.shape[1:])
        return full.index_copy(0, shown.index, values.detach())

    info = {
        "radii": scattered(shown.radii),
        "means2d": scattered(shown.means2d),
        "depths": scattered(shown.depths),
    }
    return splats[shown.depths.detach().argsort(stable=True)], info


def squared_distances(
    dx: Float[Tensor, "*batch"],
    dy: Float[Tensor, "*batch"],
    covs: Float[Tensor, "*rows 3"],
    conics: Float[Tensor, "*rows 3"],
) -> Float[Tensor, "*batch"]:
    """Mahalanobis distance squared, d^T conic d, as two squares: float32 cancels in the other form.

    Args:
        dx, dy: offsets from the centre, pixels; the rows broadcast against their last axis.
    """
    xy, yy = covs[..., 1], covs[..., 2]
    return (dx - (xy / yy) * dy).square() * conics[..., 0] + dy.square() / yy


class _Absolute(torch.autograd.Function):
    """The identity on values [P, M]; the second argument [M] receives sum_p |gradient|."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, absolutes: Tensor) -> Tensor:
        del ctx, absolutes
        return values.view_as(values)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        del ctx
        return gradient, gradient.abs().sum(0)


def splat_alphas(
    pixels: Float[Tensor, "P 2"], splats: Splats, max_alpha: float, min_alpha: float
) -> Float[Tensor, "P M"]:
    """Alpha of every splat at every pixel centre; 0 where it is skipped."""
    dx = pixels[:, :1] - splats.means2d[:, 0]
    dy = pixels[:, 1:] - splats.means2d[:, 1]
    if splats.absolutes.shape[1] == 2:
        dx = _Absolute.apply(dx, splats.absolutes[:, 0])
        dy = _Absolute.apply(dy, splats.absolutes[:, 1])
    distances = squared_distances(dx, dy, splats.covs, splats.conics)
    alphas = (splats.opacities * torch.exp(-0.5 * distances)).clamp_max(max_alpha)
    return torch.where(alphas >= min_alpha, alphas, 0.0) if min_alpha > 0 else alphas


def compositing_weights(
    alphas: Float[Tensor, "P M"], min_transmittance: float
) -> Float[Tensor, "P M"]:
    """Weights T_i alpha_i of splats that are sorted front to back along the last axis.

    The splat that would bring T down to `min_transmittance`, and all behind it, weigh nothing.
    """
    after = torch.cumprod(1.0 - alphas, dim=-1)
    before = torch.cat((torch.ones_like(after[:, :1]), after[:, :-1]), -1)[:, : after.shape[1]]
    weights = before * alphas
    if min_transmittance > 0:  # `after` never grows, so all behind the first crossing are out too
        weights = torch.where(after > min_transmittance, weights, 0.0)
    return weights


def blend(
    pixels: Float[Tensor, "P 2"], splats: Splats, request: RenderRequest
) -> Float[Tensor, "P D"]:
    """Alpha, then the channels (D = 1 + C), at pixels; memory bounded by CHUNK in both passes."""
    step = max(1, CHUNK // max(1, len(splats)))
    # recomputed in the backward pass instead of keeping a dozen [P, M] tensors for each chunk
    parts = [
        checkpoint(_blend, part, splats, request, use_reentrant=False, preserve_rng_state=False)
        for part in pixels.split(step)
    ]
    return torch.cat(parts)


def _blend(
    pixels: Float[Tensor, "P 2"], splats: Splats, request: RenderRequest
) -> Float[Tensor, "P D"]:
    alphas = splat_alphas(pixels, splats, request.max_alpha, request.min_alpha)
    weights = compositing_weights(alphas, request.min_transmittance)
    return torch.cat((weights.sum(-1, keepdim=True), weights @ splats.channels), -1)


def to_output(
    blended: Float[Tensor, "P D"], camera: Camera, request: RenderRequest, info: dict[str, Any]
) -> RenderOutput:
    """The blended pixels, row by row, as images over the background."""
    image = blended.unflatten(0, (camera.height, camera.width))
    alpha, color, depth = image[..., 0], image[..., 1:4], image[..., 4]
    if request.background is not None:
        color = color + (1.0 - alpha)[..., None] * request.background.to(color.dtype)
    features = None if request.features is None else image[..., 5:]
    return RenderOutput(color, alpha, depth, features, info)
