"""How much of each Gaussian the training frames show."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.core.model.scene import SceneModel
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip
from hoigs.core.values.gaussians import SH_C0, Gaussians

FRAMES = 16  # training frames in which weights are summed
HALF_SEEN = 0.1  # confidence is 1/2 at this share of a well seen Gaussian's weight
WELL_SEEN = 0.9  # quantile, among Gaussians with any weight, of a well seen one


def training_frames(clip: Clip, frames: int = FRAMES) -> Sequence[int]:
    """Positions of some training frames, evenly spread."""
    positions = clip.split["train"]
    return positions[:: max(1, math.ceil(len(positions) / frames))]


def seen_weights(
    model: SceneModel, clip: Clip, frames: int = FRAMES
) -> dict[str, tuple[Float[Tensor, " N"], Float[Tensor, " N"]]]:
    """Blending weights of each entity's Gaussians, summed over pixels and training frames.

    Of a person or an object those inside the entity's mask and those outside it; of a scene those
    in the whole picture, and those that it would have there alone.
    """
    scenes, names = model.names("scene"), (*model.names("human"), *model.names("object"))
    sums: dict[str, tuple[Tensor, Tensor]] = {}
    for position in training_frames(clip, frames):
        frame = clip[position]
        moment, camera = frame.moment.to(model.device), frame.camera.to(model.device)
        with torch.no_grad():
            state = model(moment)
        everywhere = torch.ones(camera.height, camera.width, device=model.device)
        masks = [(frame.masks[n] > 0).to(everywhere) if n in frame.masks else everywhere
                 for n in names]  # fmt: skip
        drawn, rows = state.joined().detach(), state.slices()
        total, *within = blending_weights(model, drawn, camera, [everywhere, *masks])
        found = {n: (w[rows[n]], (total - w)[rows[n]]) for n, w in zip(names, within, strict=True)}
        for name in scenes:
            own = state.gaussians[name].detach()
            (alone,) = blending_weights(model, own, camera, [everywhere])
            found[name] = (total[rows[name]], alone)
        for name, (one, other) in found.items():
            known = sums.get(name, (0.0, 0.0))
            sums[name] = (known[0] + one, known[1] + other)
    return sums


def blending_weights(
    model: SceneModel, drawn: Gaussians, camera: Camera, maps: Sequence[Float[Tensor, "H W"]]
) -> list[Float[Tensor, " N"]]:
    """Blending weights of the Gaussians, summed over the pixels, which each of `maps` weighs.

    The derivative of a colour by its degree-0 coefficient is the weight times Y_00, and the three
    channels have coefficients of their own: one backward gives the weights of three maps.
    """
    sh = torch.zeros(len(drawn), 1, 3, device=model.device, requires_grad=True)
    found: list[Tensor] = []
    with torch.enable_grad():
        color = model.draw(drawn.replace(sh=sh), camera, RenderRequest()).color
        for at in range(0, len(maps), 3):
            some = torch.stack(list(maps[at : at + 3]), -1)
            total = (color[..., : some.shape[-1]] * some).sum()
            (gradient,) = torch.autograd.grad(total, sh, retain_graph=True)
            found += (gradient[:, 0, : some.shape[-1]] / SH_C0).unbind(-1)
    return found


def confidence(
    inside: Float[Tensor, " N"], outside: Float[Tensor, " N"]
) -> Float[Tensor, " N"] | None:
    """How well each Gaussian was seen, in [0, 1); None if none was seen at all.

    Weight outside the mask counts against it: its colour is then somebody else's.
    """
    weight = (inside - outside).clamp_min(0)
    if not (weight > 0).any():
        return None
    half = HALF_SEEN * torch.quantile(weight[weight > 0], WELL_SEEN)
    return weight.square() / (weight.square() + half.square())
