"""The render as one differentiable function, with a hand-written backward."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import torch
from torch import Tensor

from hoigs.rasterizers.warp.frame import Images, Inputs, Lists, Settings


class Render(torch.autograd.Function):
    """Inputs in the order of `Inputs`; outputs color, alpha, depth, extra, means2d, depths, radii.

    Everything that backward needs goes through `save_for_backward`, so nothing is kept alive or
    aliased between renders.
    """

    @staticmethod
    def forward(ctx: Any, path: Any, settings: Settings, *tensors: Tensor) -> tuple[Tensor, ...]:
        inputs = Inputs(*tensors)
        with torch.cuda.device_of(inputs.means):
            projected = path.project(inputs, settings)
            lists = path.bin(projected, settings)
            images = path.composite(inputs, settings, projected.records, lists)
        ctx.path, ctx.settings = path, settings
        ctx.tiling = (lists.tile_rows, lists.across, lists.down)
        ctx.save_for_backward(
            *tensors, projected.records, lists.pairs, lists.offsets, lists.first, lists.slots,
            images.color, images.alpha, images.depth, images.extra,
        )  # fmt: skip
        ctx.mark_non_differentiable(projected.means2d, projected.depths, projected.radii)
        ctx.set_materialize_grads(False)  # else zeros are made for the last three too
        return (
            images.color, images.alpha, images.depth, images.extra,
            projected.means2d, projected.depths, projected.radii,
        )  # fmt: skip

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *upstream: Tensor | None) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        inputs, saved = Inputs(*saved[:11]), saved[11:]
        records, lists = saved[0], Lists(*ctx.tiling, *saved[1:5])
        images = Images(*saved[5:9])
        v = Images(
            *(
                torch.zeros_like(image) if x is None else x.contiguous()
                for image, x in zip(saved[5:9], upstream)
            )
        )
        needs = Inputs(*ctx.needs_input_grad[2:])
        with torch.cuda.device_of(inputs.means):
            out = ctx.path.gradients(
                inputs, ctx.settings, records, lists, images, v, pose=bool(needs.view)
            )
        background = None
        if needs.background:
            background = v.color * (1.0 - images.alpha)[..., None]
            if inputs.background.dim() == 1:
                background = background.sum((0, 1))
        gradients = {
            "means": out.means,
            "quats": out.quats,
            "log_scales": out.log_scales,
            "opacity_logits": out.opacity_logits,
            "sh": out.sh,
            "features": out.features,
            "offsets": out.offsets if needs.offsets else None,
            "background": background,
            "view": out.view(inputs) if needs.view else None,
            "K": None,
            "subset": None,
        }
        return (None, None, *(gradients[f.name] for f in fields(Inputs)))
