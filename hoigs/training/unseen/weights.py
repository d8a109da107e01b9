"""How much of each Gaussian the training frames show."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.core.maths.projection import project
from hoigs.core.model.scene import SceneModel
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip
from hoigs.core.values.gaussians import SH_C0, Gaussians

FRAMES = 16  # training frames in which weights are summed
FAINTEST = -4.0  # opacity logit, of 2 %
HALF_SEEN = 0.1  # half is known at this part of a well seen Gaussian's weight, or of its share
WELL_SEEN = 0.9  # quantile, among Gaussians with any weight, of a well seen one


def training_frames(clip: Clip, frames: int = FRAMES) -> Sequence[int]:
    """Positions of some training frames, evenly spread."""
    positions = clip.split["train"]
    return positions[:: max(1, math.ceil(len(positions) / frames))]


def seen_weights(
    model: SceneModel, clip: Clip, frames: int = FRAMES
) -> dict[str, tuple[Float[Tensor, " N"], Float[Tensor, " N"]]]:
    """Blending weights of each entity's Gaussians, summed over pixels and training frames: as they
    are, and as they would be with nothing before them, but of a scene without people and objects.

    Gaussians of people and objects are drawn with FAINTEST opacity at least: a transparent one with
    nothing before it is seen as well, to be transparent.
    """
    scenes, names = model.names("scene"), (*model.names("human"), *model.names("object"))
    sums: dict[str, tuple[Tensor, Tensor]] = {}
    for position in training_frames(clip, frames):
        frame = clip[position]
        moment, camera = frame.moment.to(model.device), frame.camera.to(model.device)
        with torch.no_grad():
            state = model(moment)
        drawn, rows = state.joined().detach(), state.slices()
        logits = drawn.opacity_logits.clone()
        for name in names:
            logits[rows[name]] = logits[rows[name]].clamp_min(FAINTEST)
        drawn = drawn.replace(opacity_logits=logits)
        shown = blending_weights(model, drawn, camera)
        alone = {name: footprints(model, drawn[rows[name]], camera) for name in names}
        for name in scenes:
            alone[name] = blending_weights(model, drawn[rows[name]], camera)
        for name in (*names, *scenes):
            known = sums.get(name, (0.0, 0.0))
            sums[name] = (known[0] + shown[rows[name]], known[1] + alone[name])
    return sums


@torch.no_grad()
def footprints(model: SceneModel, drawn: Gaussians, camera: Camera) -> Float[Tensor, " N"]:
    """The weight of each Gaussian with nothing before it: the integral of its opacity over the
    screen, square pixels; 0 where its centre is not in the picture."""
    camera = camera.to(drawn.means.dtype)
    shown = project(
        drawn.means, drawn.quats, drawn.log_scales, drawn.opacity_logits,
        camera.world_to_camera, camera.K, camera.width, camera.height,
        low_pass=model.low_pass, antialiased=model.antialiased,
    )  # fmt: skip
    size = shown.means2d.new_tensor([camera.width, camera.height])
    within = ((shown.means2d >= 0) & (shown.means2d <= size)).all(-1)
    xx, xy, yy = shown.covs.unbind(-1)
    areas = 2 * math.pi * shown.opacities * (xx * yy - xy * xy).clamp_min(0).sqrt()
    return areas.new_zeros(len(drawn)).index_copy(0, shown.index, areas * within)


def blending_weights(model: SceneModel, drawn: Gaussians, camera: Camera) -> Float[Tensor, " N"]:
    """Blending weights of the Gaussians, summed over the pixels.

    The derivative of a colour by its degree-0 coefficient is the weight times Y_00.
    """
    sh = torch.zeros(len(drawn), 1, 3, device=model.device, requires_grad=True)
    with torch.enable_grad():
        color = model.draw(drawn.replace(sh=sh), camera, RenderRequest()).color
        (gradient,) = torch.autograd.grad(color[..., 0].sum(), sh)
    return gradient[:, 0, 0] / SH_C0


def confidence(
    shown: Float[Tensor, " N"], alone: Float[Tensor, " N"]
) -> Float[Tensor, " N"] | None:
    """How well the training frames show each Gaussian, in [0, 1); None if none was seen at all.

    One is known from many pixels, or, if it is small or transparent, from a share of its few.

    Args:
        shown, alone: as `seen_weights` of one entity.
    """
    if not (shown > 0).any():
        return None
    share = torch.where(alone > 0, shown / alone.clamp_min(1e-12), 0.0)
    return 1 - (1 - _saturated(shown)) * (1 - _saturated(share))


def _saturated(values: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """x^2 / (x^2 + h^2): 1/2 at HALF_SEEN of what is common."""
    known = values[values > 0]
    if not len(known):
        return torch.zeros_like(values)
    half = HALF_SEEN * torch.quantile(known, WELL_SEEN)
    return values.square() / (values.square() + half.square())
