"""A render as one differentiable function, with a hand-written backward."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from hoigs.core.first_order import first_order
from hoigs.rasterizers.warp.frame import Images, Inputs, Settings, TileIntersections

if TYPE_CHECKING:  # it loads Warp
    from hoigs.rasterizers.warp.arguments import Projected

INPUTS = len(fields(Inputs))


def zeros(image: Tensor) -> Tensor:
    """A gradient for an image that has none; it is launched only where there are numbers."""
    return torch.zeros_like(image) if image.numel() else image


class Drawn(NamedTuple):
    """What the stages of a render have made."""

    projected: Projected
    tiles: TileIntersections
    images: Images


def draw(pipeline: Any, settings: Settings, inputs: Inputs) -> Drawn:
    """All stages of a render, without gradients."""
    with torch.no_grad(), torch.cuda.device_of(inputs.means):
        projected = pipeline.project(inputs, settings)
        tiles = pipeline.intersect(projected, settings)
        return Drawn(projected, tiles, pipeline.blend(inputs, settings, projected.records, tiles))


def render(pipeline: Any, settings: Settings, tensors: list[Tensor]) -> tuple[Tensor, ...]:
    """Outputs of `Render`. They are drawn before autograd is told of them, which takes as long as
    some of the kernels: on CUDA these then run meanwhile."""
    drawn = draw(pipeline, settings, Inputs(*tensors))
    outputs: tuple[Tensor, ...] = Render.apply(pipeline, settings, drawn, *tensors)
    return outputs


class Render(torch.autograd.Function):
    """Inputs in the order of `Inputs`; outputs are the four of `Images`, means2d, depths, radii.

    Everything that backward needs goes through `save_for_backward`, so that nothing is kept alive
    or aliased between renders.
    """

    @staticmethod
    def forward(
        ctx: Any, pipeline: Any, settings: Settings, drawn: Drawn, *tensors: Tensor
    ) -> tuple[Tensor, ...]:
        projected, tiles, images = drawn
        ctx.pipeline, ctx.settings = pipeline, settings
        ctx.tiling = (tiles.tile_height, tiles.tiles_x, tiles.tiles_y)
        ctx.save_for_backward(
            *tensors, projected.records,
            tiles.offsets, tiles.indices, tiles.first_partial, tiles.tiles_per_gaussian,
            images.color, images.alpha, images.depth, images.features,
        )  # fmt: skip
        ctx.mark_non_differentiable(projected.means2d, projected.depths, projected.radii)
        ctx.set_materialize_grads(False)  # else zeros are made for these three too
        return (
            images.color, images.alpha, images.depth, images.features,
            projected.means2d, projected.depths, projected.radii,
        )  # fmt: skip

    @staticmethod
    @first_order("WarpRasterizer", "draw with rasterizer:torch, which has the second, too")
    def backward(ctx: Any, *upstream: Tensor | None) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        inputs, (records, *saved) = Inputs(*saved[:INPUTS]), saved[INPUTS:]
        intersections, images = TileIntersections(*ctx.tiling, *saved[:4]), Images(*saved[4:])
        v = Images(
            *(
                x.contiguous() if x is not None else zeros(image)
                for image, x in zip(saved[4:], upstream)
            )
        )
        needs = Inputs(*ctx.needs_input_grad[3:])
        with torch.cuda.device_of(inputs.means):
            moving = bool(needs.K) and ctx.settings.optics
            pose = bool(needs.world_to_camera) or moving
            out = ctx.pipeline.gradients(
                inputs, ctx.settings, records, intersections, images, v, pose,
                bool(needs.absolute_gradients), bool(needs.screen_offsets),
            )  # fmt: skip
        background = None
        if needs.background:
            background = v.color * (1.0 - images.alpha)[..., None]
            if inputs.background.dim() == 1:
                background = background.sum((0, 1))
        gradients = Inputs(
            means=out.means,
            quats=out.quats,
            log_scales=out.log_scales,
            opacity_logits=out.opacity_logits,
            sh=out.sh,
            features=out.features,
            screen_offsets=out.screen_offsets if needs.screen_offsets else None,
            background=background,
            world_to_camera=out.world_to_camera(inputs) if needs.world_to_camera else None,
            K=out.camera_numbers(inputs) if moving else None,
            subset=None,
            absolute_gradients=out.absolutes if needs.absolute_gradients else None,
        )
        return (None, None, None, *vars(gradients).values())
