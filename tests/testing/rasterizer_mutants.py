"""Rasterizers with one mistake each: for every check the mutant that it has to find."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from hoigs.core.camera import Camera
from hoigs.core.errors import RenderError
from hoigs.core.gaussians import Gaussians
from hoigs.core.rasterizer import Rasterizer, RenderOutput, RenderRequest
from hoigs.rasterizers.compositing import Splats, blend, prepare, to_output
from hoigs.rasterizers.torch_tiles import TorchRasterizer

Call = tuple[Gaussians, Camera, RenderRequest]
RIGHT = TorchRasterizer.capabilities


class Mutant(Rasterizer):
    """A right rasterizer whose input or output is tampered with."""

    def __init__(
        self,
        before: Callable[[Gaussians, Camera, RenderRequest], Call] | None = None,
        after: Callable[[RenderOutput, Gaussians, Camera, RenderRequest], RenderOutput]
        | None = None,
        **declared: Any,
    ) -> None:
        self.before, self.after = before, after
        self.capabilities = replace(RIGHT, **declared)
        self.calls = 0

    def render(
        self, gaussians: Gaussians, camera: Camera, request: RenderRequest | None = None
    ) -> RenderOutput:
        call = (gaussians, camera, request or RenderRequest())
        self.check_inputs(*call)
        if self.before is not None:
            call = self.before(*call)
        output = TorchRasterizer().render(*call)
        return output if self.after is None else self.after(output, *call)


class Reordered(Rasterizer):
    """Composites in another order than depth, ties by index."""

    capabilities = RIGHT

    def __init__(self, order: Callable[[Splats], Tensor]) -> None:
        self.order = order

    def render(
        self, gaussians: Gaussians, camera: Camera, request: RenderRequest | None = None
    ) -> RenderOutput:
        request = request or RenderRequest()
        self.check_inputs(gaussians, camera, request)
        camera = camera.to(gaussians.means.dtype)
        splats, info = prepare(gaussians, camera, request)
        splats = splats[self.order(splats)]
        return to_output(
            blend(camera.pixel_grid().flatten(0, 1), splats, request), camera, request, info
        )


def ties_backwards(splats: Splats) -> Tensor:
    last_first = torch.arange(len(splats)).flip(0)
    return last_first[splats.channels[last_first, 3].argsort(stable=True)]


class Forgiving(TorchRasterizer):
    """Draws nothing where it should refuse."""

    def render(
        self, gaussians: Gaussians, camera: Camera, request: RenderRequest | None = None
    ) -> RenderOutput:
        try:
            return super().render(gaussians, camera, request)
        except RenderError:
            blank = torch.zeros(1, 1)
            return RenderOutput(blank[..., None].expand(1, 1, 3), blank, blank)


class Accepting(TorchRasterizer):
    """Declares an option fixed and draws with any value."""

    capabilities = RIGHT

    def __init__(self) -> None:
        super().__init__()
        self.capabilities = replace(RIGHT, fixed={"max_alpha": 0.999})

    def check_inputs(self, *call: Any) -> None:
        TorchRasterizer().check_inputs(*call)


class Numbered(Mutant):
    """Each picture a little brighter than the one before."""

    def __init__(self) -> None:
        super().__init__(after=self.brighten)

    def brighten(self, output: RenderOutput, *call: Any) -> RenderOutput:
        self.calls += 1
        return replace(output, color=output.color * (1 + 1e-3 * self.calls))


def asked(**values: Any) -> Mutant:
    """Ignores what the request says of these."""
    return Mutant(lambda g, c, r: (g, c, r.replace(**values)))


def on_rows(change: Callable[[Gaussians, Camera], Gaussians]) -> Mutant:
    return Mutant(lambda g, c, r: (change(g, c), c, r))


def on_request(change: Callable[[RenderRequest], RenderRequest]) -> Mutant:
    return Mutant(lambda g, c, r: (g, c, change(r)))


def on_output(change: Callable[[RenderOutput, Gaussians, Camera, RenderRequest], Any]) -> Mutant:
    """`change` returns the fields of the output that it replaces."""
    return Mutant(after=lambda o, *call: replace(o, **change(o, *call)))


def half_gradient(x: Tensor) -> Tensor:
    return x.detach() + 0.5 * (x - x.detach())


def leak(x: Tensor) -> Tensor:
    """Zero, with a gradient."""
    return 1e-3 * (x - x.detach()).sum()


def outside(gaussians: Gaussians, camera: Camera, margin: float) -> Tensor:
    """Rows whose centre is off the image by more than a margin, in image sizes."""
    uv, _ = camera.to(gaussians.means.dtype).project(gaussians.means)
    size = uv.new_tensor([camera.width, camera.height])
    return ((uv < -margin * size) | (uv > (1 + margin) * size)).any(-1)


def hidden(gaussians: Gaussians, rows: Tensor) -> Gaussians:
    faint = torch.full_like(gaussians.opacity_logits, -50.0)
    return gaussians.replace(opacity_logits=torch.where(rows, faint, gaussians.opacity_logits))


def fields(gaussians: Gaussians) -> Tensor:
    return torch.cat([getattr(gaussians, name).flatten() for name in gaussians.__dict__])


def centred(camera: Camera) -> Camera:
    K = camera.K.clone()
    K[0, 2], K[1, 2] = camera.width / 2, camera.height / 2
    return replace(camera, K=K)


def unless(condition: Any, value: Tensor, otherwise: float) -> Tensor:
    return value if not bool(condition) else torch.full_like(value, otherwise)


def normalised_in_place(gaussians: Gaussians, camera: Camera) -> Gaussians:
    with torch.no_grad():
        gaussians.quats.div_(gaussians.quats.norm(dim=-1, keepdim=True))
    return gaussians


def refuse_empty(gaussians: Gaussians, camera: Camera) -> Gaussians:
    if len(gaussians) == 0:
        raise ZeroDivisionError("no rows")
    return gaussians


def occluding(g: Gaussians, c: Camera, r: RenderRequest) -> Call:
    """Rows outside the subset are black instead of absent."""
    if r.subset is None:
        return g, c, r
    black = torch.full_like(g.sh, 0.0)
    black[:, 0] = -10.0
    return (
        g.replace(sh=torch.where(r.subset[:, None, None], g.sh, black)),
        c,
        r.replace(subset=None),
    )


MUTANTS: dict[str, Callable[[], Rasterizer]] = {
    "R01": lambda: on_output(lambda o, *_: {"depth": o.depth * 1.01}),
    "R02": lambda: on_output(lambda o, *_: {"features": o.color}),
    "R03": lambda: Reordered(lambda splats: splats.channels[:, 3].argsort(descending=True)),
    "R04": lambda: Reordered(ties_backwards),
    "R05": lambda: asked(max_alpha=0.999),
    "R06": lambda: asked(min_alpha=1 / 255),
    "R07": lambda: asked(min_transmittance=1e-4),
    "R08": lambda: asked(near=0.01),
    "R09": lambda: asked(low_pass=0.3),
    "R10": lambda: on_rows(lambda g, c: hidden(g, outside(g, c, 0.4))),
    "R11": lambda: Mutant(lambda g, c, r: (g, centred(c), r)),
    "R12": lambda: on_request(
        lambda r: r if r.background is None or r.background.dim() == 1
        else r.replace(background=r.background * 0.9)
    ),
    "R13": lambda: on_rows(lambda g, c: g.replace(means=g.means.clamp(-3.2, 3.2))),
    "R20": lambda: on_output(
        lambda o, *_: {} if o.features is None else {"features": o.features.abs()}
    ),
    "R21": lambda: on_output(lambda o, g, c, r: {"color": unless(c.width < 4, o.color, 0.0)}),
    "R22": lambda: on_output(
        lambda o, *_: {"alpha": torch.cat((o.alpha[:2900], 0 * o.alpha[2900:]))}
    ),
    "R23": lambda: asked(sh_degree=None),
    "R24": lambda: on_rows(lambda g, c: g.replace(opacity_logits=g.opacity_logits.clamp_max(4.0))),
    "R25": lambda: on_rows(lambda g, c: hidden(g, outside(g, c, 0.0))),
    "R26": lambda: on_rows(lambda g, c: hidden(g, outside(g, c, 1.5))),
    "R27": lambda: on_output(
        lambda o, *_: {} if o.features is None
        else {"features": o.features * (torch.arange(o.features.shape[-1]) < 32)}
    ),
    "R30": lambda: on_output(lambda o, *_: {"info": {"radii": o.info["radii"].sort().values}}),
    "R31": lambda: on_output(
        lambda o, *_: {} if o.features is None
        else {"features": o.features / o.features.shape[-1]}
    ),
    "R32": lambda: Mutant(occluding),
    "R33": lambda: on_rows(refuse_empty),
    "R34": lambda: on_output(
        lambda o, *_: {"depth": unless(not o.alpha.any(), o.depth, 1.0)}
    ),
    "R35": lambda: on_output(lambda o, g, *_: {"alpha": unless(len(g) == 1, o.alpha, 0.0)}),
    "R40": lambda: on_rows(lambda g, c: g.replace(log_scales=half_gradient(g.log_scales))),
    "R41": lambda: on_output(lambda o, *_: {"alpha": half_gradient(o.alpha)}),
    "R42": lambda: Mutant(
        lambda g, c, r: (g, replace(c, world_to_camera=half_gradient(c.world_to_camera)), r)
    ),
    "R43": lambda: on_rows(lambda g, c: g.replace(sh=half_gradient(g.sh))),
    "R44": lambda: on_request(
        lambda r: r if r.background is None else r.replace(background=half_gradient(r.background))
    ),
    "R45": lambda: on_request(
        lambda r: r if r.screen_offsets is None
        else r.replace(screen_offsets=half_gradient(r.screen_offsets))
    ),
    "R46": lambda: on_output(lambda o, g, *_: {"alpha": o.alpha + leak(g.opacity_logits)}),
    "R47": lambda: on_output(lambda o, g, *_: {"color": o.color + leak(g.sh)}),
    "R48": lambda: on_output(lambda o, g, *_: {"depth": o.depth + leak(g.means)}),
    "R49": lambda: on_rows(lambda g, c: g.replace(quats=half_gradient(g.quats))),
    "R50": lambda: Mutant(
        lambda g, c, r: (g.map(lambda x: x + 1e-7), c, r)
    ),
    "R60": lambda: on_output(
        lambda o, g, *_: {"color": unless(fields(g).isnan().any(), o.color, 0.0)}
    ),
    "R61": lambda: on_output(
        lambda o, g, *_: {"color": unless((fields(g).abs() > 1e37).any(), o.color, 0.0)}
    ),
    "R62": lambda: on_output(
        lambda o, g, *_: {
            "color": unless(((fields(g) != 0) & (fields(g).abs() < 1e-38)).any(), o.color, 0.0)
        }
    ),
    "R63": lambda: on_output(
        lambda o, g, *_: {"color": unless((g.sh.abs() > 1e20).any(), o.color, 0.0)}
    ),
    "R64": lambda: on_output(
        lambda o, g, c, r: {"depth": o.depth + 0.0 * c.K.sum() * c.world_to_camera.sum()}
    ),
    "R65": lambda: on_output(
        lambda o, g, c, r: {}
        if r.background is None else {"alpha": o.alpha + 0.0 * r.background.sum()}
    ),
    "R80": lambda: on_output(lambda o, *_: {"color": o.color + 1e-7 * torch.rand(1)}),
    "R81": Numbered,
    "R82": lambda: on_rows(normalised_in_place),
    "R83": lambda: on_output(
        lambda o, *_: {"color": o.color + leak(torch.zeros(1, requires_grad=True))}
    ),
    "R84": Forgiving,
    "R85": Forgiving,
    "R86": Accepting,
}  # fmt: skip
