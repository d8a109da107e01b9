"""A right rasterizer that draws every picture once, so that fifty mutants of it cost little."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any

import torch
from torch import Tensor

from hoigs.core.interfaces.rasterizer import Rasterizer, RenderOutput, RenderRequest
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import FIELDS, Gaussians
from hoigs.rasterizers.torch_tiles import TorchRasterizer
from hoigs.testing.rasterizer.subject import forged

RAW = FIELDS
ASKED = ("features", "screen_offsets", "background", "absolute_gradients")


@dataclass
class Kept:
    """An output without its graph, and gradients of the inputs by those of the images."""

    output: RenderOutput
    gradients: dict[Any, tuple[Tensor | None, ...]] = field(default_factory=dict)


KEPT: dict[Any, Kept] = {}


class Remembering(Rasterizer):
    """`rasterizer:torch`; outputs and gradients are kept by the bits of all that goes in."""

    capabilities = TorchRasterizer.capabilities

    def render(
        self, gaussians: Gaussians, camera: Camera, request: RenderRequest | None = None
    ) -> RenderOutput:
        request = request or RenderRequest()
        self.check_inputs(gaussians, camera, request)
        asked = [name for name in ASKED if getattr(request, name) is not None]
        inputs = [getattr(gaussians, name) for name in RAW]
        inputs += [camera.world_to_camera, *(getattr(request, name) for name in asked)]
        optics = camera.optics
        if optics is not None and optics.last_world_to_camera is not None:
            inputs.append(optics.last_world_to_camera)

        def draw(*x: Tensor) -> RenderOutput:
            view = forged(camera, world_to_camera=x[len(RAW)])
            if len(x) > len(RAW) + 1 + len(asked) and optics is not None:
                view = forged(view, optics=replace(optics, last_world_to_camera=x[-1]))
            values = dict(zip(asked, x[len(RAW) + 1 :]))
            return TorchRasterizer().render(
                Gaussians(*x[: len(RAW)]), view, request.replace(**values)
            )

        values = [getattr(request, f.name) for f in fields(request)]
        others = [camera.K, *([] if request.subset is None else [request.subset])]
        numbers = [value for value in values if not isinstance(value, Tensor)]
        if optics is not None:
            numbers += [optics.model, optics.shutter, *optics.coefficients]
        key = (camera.width, camera.height, *numbers, *asked, bits(*inputs, *others))
        if key not in KEPT:
            with torch.no_grad():
                KEPT[key] = Kept(draw(*inputs))
        images = _Draw.apply(draw, KEPT[key], *inputs)
        color, alpha, depth, features = (*images, None)[:4]
        return RenderOutput(color, alpha, depth, features, dict(KEPT[key].output.info))


class _Draw(torch.autograd.Function):
    """The images that are kept; their gradients are worked out when they are first asked for."""

    @staticmethod
    def forward(ctx: Any, draw: Callable[..., RenderOutput], kept: Kept, *inputs: Tensor) -> Any:
        ctx.draw, ctx.kept = draw, kept
        ctx.inputs = [x.detach().clone() for x in inputs]  # a mutant may write into its inputs
        return tuple(image.view_as(image) for image in images(kept.output))

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor) -> Any:
        wanted = ctx.needs_input_grad[2:]
        key = (wanted, bits(*slopes))
        if key not in ctx.kept.gradients:
            leaves = [x.requires_grad_(want) for x, want in zip(ctx.inputs, wanted)]
            with torch.enable_grad():
                drawn = list(zip(images(ctx.draw(*leaves)), slopes))
            graphs, starts = zip(*((image, s) for image, s in drawn if image.requires_grad))
            asked = [x for x in leaves if x.requires_grad]
            found = iter(torch.autograd.grad(graphs, asked, starts, allow_unused=True))
            ctx.kept.gradients[key] = tuple(next(found) if want else None for want in wanted)
        return None, None, *ctx.kept.gradients[key]


def images(output: RenderOutput) -> list[Tensor]:
    found = [output.color, output.alpha, output.depth]
    return found if output.features is None else [*found, output.features]


def bits(*tensors: Tensor) -> tuple[Any, ...]:
    return tuple((x.dtype, x.shape, x.detach().numpy().tobytes()) for x in tensors)
