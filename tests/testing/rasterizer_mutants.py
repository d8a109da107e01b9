"""Rasterizers with one mistake each: for every check the mutant that it alone has to find.

Most checks draw whole scenes, so a mistake that only one of them may see shows only where that
check looks: with one row, with nine channels, in float64, five metres from the origin.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from remembering import Remembering
from torch import Tensor

from hoigs.core.errors import RenderError
from hoigs.core.interfaces.rasterizer import Rasterizer, RenderOutput, RenderRequest
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import SH_C0, Gaussians
from hoigs.rasterizers.compositing import Splats, blend, prepare, to_output

Call = tuple[Gaussians, Camera, RenderRequest]
RIGHT = Remembering.capabilities
TINY = torch.finfo(torch.float32).tiny


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

    def render(
        self, gaussians: Gaussians, camera: Camera, request: RenderRequest | None = None
    ) -> RenderOutput:
        call = (gaussians, camera, request or RenderRequest())
        self.check_inputs(*call)
        if self.before is not None:
            call = self.before(*call)
        output = Remembering().render(*call)
        return output if self.after is None else self.after(output, *call)


def on_rows(change: Callable[[Gaussians, Camera, RenderRequest], Gaussians]) -> Mutant:
    return Mutant(lambda g, c, r: (change(g, c, r), c, r))


def on_camera(change: Callable[[Camera], Camera]) -> Mutant:
    return Mutant(lambda g, c, r: (g, change(c), r))


def on_request(change: Callable[[RenderRequest, Gaussians], dict[str, Any]]) -> Mutant:
    """`change` returns the fields of the request that it replaces."""
    return Mutant(lambda g, c, r: (g, c, r.replace(**change(r, g))))


def on_output(change: Callable[[RenderOutput, Gaussians, Camera, RenderRequest], Any]) -> Mutant:
    """`change` returns the fields of the output that it replaces."""
    return Mutant(after=lambda o, *call: replace(o, **change(o, *call)))


class Reordered(Mutant):
    """Composites in another order than depth, ties by index."""

    def __init__(self, order: Callable[[Splats], Tensor]) -> None:
        super().__init__()
        self.order = order

    def render(
        self, gaussians: Gaussians, camera: Camera, request: RenderRequest | None = None
    ) -> RenderOutput:
        output, request = super().render(gaussians, camera, request), request or RenderRequest()
        view = camera.to(gaussians.means.dtype)
        splats, info = prepare(gaussians, view, request)
        order = self.order(splats)
        if torch.equal(order, torch.arange(len(order))):
            return output
        pixels = blend(view.pixel_grid().flatten(0, 1), splats[order], request)
        return to_output(pixels, view, request, info)


def two_backwards(splats: Splats) -> Tensor:
    apart = len(splats) == 2 and bool(splats.channels[0, 3] < splats.channels[1, 3])
    return torch.tensor([1, 0]) if apart else torch.arange(len(splats))


def tie_backwards(splats: Splats) -> Tensor:
    tied = len(splats) == 2 and bool(splats.channels[0, 3] == splats.channels[1, 3])
    return torch.tensor([1, 0]) if tied else torch.arange(len(splats))


class Forgiving(Mutant):
    """Draws nothing where it should refuse."""

    def __init__(self, forgives: Callable[[str], bool]) -> None:
        super().__init__()
        self.forgives = forgives

    def render(
        self, gaussians: Gaussians, camera: Camera, request: RenderRequest | None = None
    ) -> RenderOutput:
        try:
            return super().render(gaussians, camera, request)
        except RenderError as error:
            if not self.forgives(str(error)):
                raise
            blank = torch.zeros(1, 1)
            return RenderOutput(blank[..., None].expand(1, 1, 3), blank, blank)


class Accepting(Mutant):
    """Declares an option fixed and draws with any value."""

    def __init__(self) -> None:
        super().__init__(fixed={"max_alpha": 0.999})

    def check_inputs(self, *call: Any) -> None:
        declared, self.capabilities = self.capabilities, RIGHT
        try:
            super().check_inputs(*call)
        finally:
            self.capabilities = declared


class AnyLens(Mutant):
    """Draws every camera as a pinhole."""

    def __init__(self) -> None:
        super().__init__(lambda g, c, r: (g, replace(c, optics=None), r), optics=frozenset())

    def check_inputs(self, gaussians: Any, camera: Any, request: Any) -> None:
        plain = replace(camera, optics=None) if getattr(camera, "optics", None) else camera
        super().check_inputs(gaussians, plain, request)


class BrighterCopies(Mutant):
    gain = 1.0

    def render(self, *call: Any) -> RenderOutput:
        output = super().render(*call)
        return replace(output, color=output.color * self.gain)

    def __deepcopy__(self, memo: Any) -> BrighterCopies:
        copy = type(self)()
        copy.gain = 1.0 + 1e-4
        return copy


class _OnlyOne(torch.autograd.Function):
    """Images as they are; features get half of a gradient that comes through them alone."""

    @staticmethod
    def forward(ctx: Any, *images: Tensor) -> Any:
        return tuple(image.view_as(image) for image in images)

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor) -> Any:
        alone = not any(slope.any() for slope in slopes[:-1])
        return *slopes[:-1], slopes[-1] * (0.5 if alone else 1.0)


def features_alone(o: RenderOutput, g: Gaussians, c: Camera, r: RenderRequest) -> Any:
    if o.features is None or o.color.dtype == torch.float64:
        return {}
    names = ("color", "alpha", "depth", "features")
    return dict(zip(names, _OnlyOne.apply(*(getattr(o, name) for name in names))))


def scaled_gradient(x: Tensor, factor: float | Tensor = 0.5) -> Tensor:
    return x.detach() + factor * (x - x.detach())


def leak(x: Tensor) -> Tensor:
    """Zero, with a gradient."""
    return 1e-3 * (x - x.detach()).sum()


def single(g: Gaussians) -> bool:
    return g.means.dtype == torch.float32


def outside(gaussians: Gaussians, camera: Camera, margin: float) -> Tensor:
    """Rows whose centre is off the image by more than a margin, in image sizes."""
    uv, _ = camera.to(gaussians.means.dtype).project(gaussians.means)
    size = uv.new_tensor([camera.width, camera.height])
    return ((uv < -margin * size) | (uv > (1 + margin) * size)).any(-1)


def hidden(gaussians: Gaussians, rows: Tensor) -> Gaussians:
    faint = torch.full_like(gaussians.opacity_logits, -50.0)
    return gaussians.replace(opacity_logits=torch.where(rows, faint, gaussians.opacity_logits))


def principal_point_near_the_middle(camera: Camera) -> Camera:
    size = camera.K.new_tensor([camera.width, camera.height])
    K = camera.K.clone()
    K[:2, 2] = K[:2, 2].clamp(0.32 * size, 0.68 * size)
    return replace(camera, K=K)


def darker_if_flat(request: RenderRequest, _: Gaussians) -> dict[str, Any]:
    back = request.background
    flat = back is not None and back.dim() == 3 and bool((back == back[0, 0]).all())
    return {"background": 0.9 * back} if flat else {}


def half_floats_far_off(g: Gaussians, c: Camera, r: RenderRequest) -> Gaussians:
    return g.replace(means=g.means.half().to(g.means)) if c.center.norm() > 5.0 else g


def mirrored_behind(g: Gaussians, c: Camera, r: RenderRequest) -> Gaussians:
    """What is less than a metre behind the camera is seen through the back of the lens."""
    view = c.to(g.means.dtype)
    z = view.to_camera(g.means)[:, 2:]
    return g.replace(
        means=torch.where((z > -1.0) & (z < -0.05), 2 * view.center - g.means, g.means)
    )


def all_behind(g: Gaussians, c: Camera) -> bool:
    return len(g) > 0 and bool((c.to(g.means.dtype).to_camera(g.means)[:, 2] < 0).all())


def occluding(g: Gaussians, c: Camera, r: RenderRequest) -> Call:
    """With features, rows outside the subset are black instead of absent."""
    if r.subset is None or r.features is None:
        return g, c, r
    black = torch.full_like(g.sh, 0.0)
    black[:, 0] = -10.0
    sh = torch.where(r.subset[:, None, None], g.sh, black)
    return g.replace(sh=sh), c, r.replace(subset=None)


def refuse_empty(g: Gaussians, *_: Any) -> Gaussians:
    if len(g) == 0:
        raise ZeroDivisionError("no rows")
    return g


def negative_nan_is_zero(x: Tensor) -> Tensor:
    return torch.where(x.isnan() & x.signbit(), 0.0, x)


def scribbled_on(o: RenderOutput, g: Gaussians, *_: Any) -> dict[str, Any]:
    if g.means.requires_grad and single(g):
        g.means.data += 1e-6
    return {}


def per_channel(factor: Callable[[int], Tensor]) -> Mutant:
    """Features times a factor of each channel."""
    return on_output(
        lambda o, *_: (
            {} if o.features is None else {"features": o.features * factor(o.features.shape[-1])}
        )
    )


IDENTITY = torch.tensor([1.0, 0, 0, 0])
# id: name of the mistake, and a rasterizer that makes it
MUTANTS: dict[str, tuple[str, Callable[[], Rasterizer]]] = {
    "R01": ("RadiusPlusOne", lambda: on_output(
        lambda o, *_: {"info": o.info | {"radii": o.info["radii"] + (o.info["radii"] > 0)}}
    )),
    "R02": ("FeaturesUnasked", lambda: on_output(
        lambda o, *_: {} if o.features is not None else {"features": o.color.detach()}
    )),
    "R03": ("TwoBackwards", lambda: Reordered(two_backwards)),
    "R04": ("TieBackwards", lambda: Reordered(tie_backwards)),
    "R05": ("NeverQuiteSolid", lambda: on_request(
        lambda r, g: {"max_alpha": min(r.max_alpha, 0.999)}
    )),
    "R06": ("EdgeAtAThousandth", lambda: on_request(
        lambda r, g: {"min_alpha": r.min_alpha and max(r.min_alpha, 1e-3)}
    )),
    "R07": ("StopsAtAHundredthAtMost", lambda: on_request(
        lambda r, g: {"min_transmittance": min(r.min_transmittance, 0.01)}
    )),
    "R08": ("NeverNearer", lambda: on_request(lambda r, g: {"near": max(r.near, 0.05)})),
    "R09": ("OneLowPass", lambda: on_request(lambda r, g: {"low_pass": 0.3})),
    "R10": ("CulledBeforeTheOffset", lambda: on_rows(
        lambda g, c, r: g if r.screen_offsets is None else hidden(g, outside(g, c, 0.9))
    )),
    "R11": ("PrincipalPointNearTheMiddle", lambda: on_camera(principal_point_near_the_middle)),
    "R12": ("DarkerFlatBackground", lambda: on_request(darker_if_flat)),
    "R13": ("HalfFloatsFarOff", lambda: on_rows(half_floats_far_off)),
    "R14": ("OneKeepsItsOpacity", lambda: on_request(
        lambda r, g: {"antialiased": False} if len(g) == 1 else {}
    )),
    "R20": ("CornersAsCentres", lambda: on_output(
        lambda o, *_: {"info": o.info | {"means2d": o.info["means2d"] - 0.5}}
    )),
    "R21": ("NarrowIsBlack", lambda: on_output(
        lambda o, g, c, r: {} if c.width >= 4 else {"color": 0 * o.color}
    )),
    "R22": ("EndsAtRow2900", lambda: on_output(
        lambda o, *_: {"alpha": torch.cat((o.alpha[:2900], 0 * o.alpha[2900:]))}
    )),
    "R23": ("AllHarmonics", lambda: on_request(lambda r, g: {"sh_degree": None})),
    "R24": ("FaintIsNothing", lambda: on_rows(lambda g, c, r: hidden(g, g.opacity_logits < -5.4))),
    "R25": ("MirroredBehind", lambda: on_rows(
        lambda g, c, r: mirrored_behind(g, c, r) if c.optics is None else g
    )),
    "R26": ("CulledByItsCentre", lambda: on_rows(lambda g, c, r: hidden(g, outside(g, c, 2.0)))),
    "R27": ("ThirtyTwoChannels", lambda: per_channel(lambda count: torch.arange(count) < 32)),
    "R30": ("RadiiKnowTheirRow", lambda: on_output(
        lambda o, g, *_: {"info": {"radii": o.info["radii"] * (1 + 1e-5 * torch.arange(len(g)))}}
    )),
    "R31": ("NinthChannelLost", lambda: per_channel(
        lambda count: torch.arange(count) < (8 if count == 9 else count)
    )),
    "R32": ("OccludingBlack", lambda: Mutant(occluding)),
    "R33": ("NeedsOneRow", lambda: on_rows(refuse_empty)),
    "R34": ("DepthBehind", lambda: on_output(
        lambda o, g, c, r: {"depth": o.depth + 1} if all_behind(g, c) else {}
    )),
    "R35": ("OneRowHasNoHarmonics", lambda: on_rows(
        lambda g, *_: g.replace(sh=g.sh[:, :1]) if len(g) == 1 else g
    )),
    "R40": ("HalfAScaleGradient", lambda: on_rows(
        lambda g, c, r: g if r.screen_offsets is None or r.screen_offsets.any()
        else g.replace(log_scales=scaled_gradient(g.log_scales))
    )),
    "R41": ("FeaturesAlone", lambda: on_output(features_alone)),
    "R42": ("HalfAPoseGradient", lambda: Mutant(
        lambda g, c, r: (g, c, r) if r.screen_offsets is None or r.screen_offsets.any()
        else (g, replace(c, world_to_camera=scaled_gradient(c.world_to_camera)), r)
    )),
    "R43": ("HalfAHarmonicGradient", lambda: on_rows(
        lambda g, *_: g.replace(sh=scaled_gradient(g.sh)) if g.sh.shape[1] == 9 else g
    )),
    "R44": ("HalfABackgroundGradient", lambda: on_request(
        lambda r, g: {"background": scaled_gradient(r.background)}
        if r.background is not None and r.background.dim() == 1 and single(g) else {}
    )),
    "R45": ("HalfAnOffsetGradient", lambda: on_request(
        lambda r, g: {} if r.screen_offsets is None or r.features is not None
        else {"screen_offsets": scaled_gradient(r.screen_offsets)}
    )),
    "R46": ("LeaksWhereClamped", lambda: on_output(
        lambda o, g, c, r: {"alpha": o.alpha + leak(g.opacity_logits)} if r.max_alpha < 0.5 else {}
    )),
    "R47": ("LeaksBelowZero", lambda: on_output(
        lambda o, g, *_: {"color": o.color + leak(g.sh[(g.colors < 0).any(-1) & (len(g) == 1)])}
    )),
    "R48": ("LeaksWhereCulled", lambda: on_output(
        lambda o, g, c, r: {} if r.features is not None
        else {"depth": o.depth + leak(g.means[g.opacity_logits < -6.0])}
    )),
    "R49": ("HalfATurnGradient", lambda: on_rows(
        lambda g, c, r: g if r.min_alpha > 0 else g.replace(quats=scaled_gradient(g.quats))
    )),
    "R50": ("RoundedLowPass", lambda: on_request(
        lambda r, g: {} if single(g) else {"low_pass": r.low_pass + 1e-7}
    )),
    "R51": ("HalfAnAbsoluteGradient", lambda: on_request(
        lambda r, g: {} if r.absolute_gradients is None
        else {"absolute_gradients": scaled_gradient(r.absolute_gradients)}
    )),
    "R52": ("HalfAScaleGradientOfDiscs", lambda: on_rows(
        lambda g, c, r: g if not r.antialiased or len(g) == 1 or c.optics is not None
        else g.replace(log_scales=scaled_gradient(g.log_scales))
    )),
    "R53": ("BlackStaysBlack", lambda: on_rows(
        lambda g, *_: g.replace(sh=torch.where(
            (0.5 + SH_C0 * g.sh[:, :1] > 0) | (g.sh[:, :1] < -2), g.sh, g.sh.detach()
        ))
    )),
    "R60": ("ZeroIsTheIdentity", lambda: on_rows(
        lambda g, *_: g.replace(
            quats=torch.where((g.quats == 0).all(-1, True), IDENTITY.to(g.quats), g.quats)
        )
    )),
    "R61": ("NegativeNanIsZero", lambda: on_rows(lambda g, *_: g.map(negative_nan_is_zero))),
    "R62": ("TinyIsNothing", lambda: on_rows(
        lambda g, *_: hidden(g, ((g.means != 0) & (g.means.abs() < TINY)).all(-1))
    )),
    "R63": ("HugeLogitIsNothing", lambda: on_rows(
        lambda g, *_: hidden(g, (g.opacity_logits > 1e20) & g.opacity_logits.isfinite())
    )),
    "R64": ("BrokenCameraShows", lambda: on_output(
        lambda o, g, c, r: {"depth": o.depth + 0.0 * c.K.sum() * c.world_to_camera.sum()}
    )),
    "R65": ("BrokenPixelSpreads", lambda: on_output(
        lambda o, g, c, r: {}
        if r.background is None else {"alpha": o.alpha + 0.0 * r.background.sum()}
    )),
    "R66": ("InfiniteLogitIsNothing", lambda: on_rows(
        lambda g, *_: hidden(g, g.opacity_logits.isinf())
    )),
    "R70": ("DeeperThroughALens", lambda: on_output(
        lambda o, g, c, r: {} if c.optics is None else {"depth": o.depth + 1e-3}
    )),
    "R71": ("HalfAScaleGradientThroughALens", lambda: Mutant(lambda g, c, r: (
        g if c.optics is None else g.replace(log_scales=scaled_gradient(g.log_scales)), c, r
    ))),
    "R72": ("TakesAnyLens", AnyLens),
    "R80": ("DicedGradient", lambda: on_rows(
        lambda g, *_: g.replace(sh=scaled_gradient(g.sh, 1 + 3e-5 * torch.rand(1)))
        if single(g) else g
    )),
    "R81": ("BrighterCopies", BrighterCopies),
    "R82": ("ScribbledOn", lambda: on_output(scribbled_on)),
    "R83": ("GraphWithoutReason", lambda: on_output(
        lambda o, *_: {"color": o.color + leak(torch.zeros(1, requires_grad=True))}
    )),
    "R84": ("ForgivesShapes", lambda: Forgiving(lambda why: "meta" not in why)),
    "R85": ("ForgivesDevices", lambda: Forgiving(lambda why: "meta" in why)),
    "R86": ("AcceptsAnyLimit", Accepting),
}  # fmt: skip
