"""gsplat without nvcc: `rasterization` with gsplat's signature, drawn by Warp on CPUs and on CUDA.

    from hoigs.gsplat import rasterization  # for: from gsplat import rasterization

Names, shapes and defaults are those of gsplat 1.5 (Ye et al. 2024, arXiv:2409.06765), so that its
training loops and its `DefaultStrategy` and `MCMCStrategy` run unmodified. What is drawn obeys
`hoigs.core.maths.projection`; with gsplat's cut-offs, which are the defaults there, both agree to
rounding. What is not supported raises `RenderError` with the name of the argument.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal, cast, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hoigs.core.errors import RenderError
from hoigs.core.interfaces.rasterizer import Rasterizer, RenderOutput, RenderRequest
from hoigs.core.maths.optics import COEFFICIENTS, Model, Optics, Shutter
from hoigs.core.maths.projection import LIMIT, Projection, project
from hoigs.core.maths.spherical_harmonics import not_negative, sh_basis
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians

__all__ = ["rasterization"]

MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
MIN_ALPHA = 1.0 / 255.0  # gsplat's; a Gaussian's box is where its alpha is above it
WIDEST_BOX = 3.33  # standard deviations
# gsplat's RollingShutterType, by number
SHUTTERS: tuple[Shutter, ...] = (
    "top_to_bottom", "left_to_right", "bottom_to_top", "right_to_left", "global",
)  # fmt: skip
# arguments of gsplat's that other cameras, several machines or other primitives need
UNSUPPORTED = (
    "sparse_grad", "distributed", "covars", "with_eval3d", "ftheta_coeffs", "lidar_coeffs",
    "external_distortion_coeffs", "return_normals", "extra_signals", "extra_signals_sh_degree",
    "rays", "ut_params", "renderer_config",
)  # fmt: skip


def rasterization(
    means: Float[Tensor, "*B N 3"],
    quats: Float[Tensor, "*B N 4"],
    scales: Float[Tensor, "*B N 3"],
    opacities: Float[Tensor, "*B N"],
    colors: Tensor,
    viewmats: Float[Tensor, "*B C 4 4"],
    Ks: Float[Tensor, "*B C 3 3"],
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: Float[Tensor, "*B C D"] | None = None,
    render_mode: Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"] = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    with_ut: bool = False,
    *,
    global_z_order: bool = True,
    radial_coeffs: Float[Tensor, "*B C k"] | None = None,
    tangential_coeffs: Float[Tensor, "*B C 2"] | None = None,
    thin_prism_coeffs: Float[Tensor, "*B C 4"] | None = None,
    rolling_shutter: int | Shutter = "global",
    viewmats_rs: Float[Tensor, "*B C 4 4"] | None = None,
    rasterizer: Rasterizer | None = None,
    **others: Any,
) -> tuple[Float[Tensor, "*B C H W X"], Float[Tensor, "*B C H W 1"], dict[str, Any]]:
    """Draw Gaussians as seen by C cameras.

    Gradients reach `means`, `quats`, `scales`, `opacities`, `colors`, `viewmats`, `viewmats_rs` and
    `backgrounds`.

    Args:
        means: centres. quats: wxyz of any length. scales: standard deviations (activated).
        opacities: in [0, 1] (activated).
        colors: [*B, (C,) N, D], any numbers; with `sh_degree`, SH coefficients [*B, (C,) N, K, 3].
        viewmats: world to camera, OpenCV axes. Ks: pixels; of "ortho", pixels per metre.
        near_plane, far_plane: Gaussians whose centres are outside are culled.
        radius_clip: Gaussians whose box is not larger, in both directions, are culled; pixels.
        eps2d: variance added to the screen covariance, square pixels.
        sh_degree: 0 to 4; None: `colors` are no coefficients.
        packed: whether the tensors of `info` hold only what is drawn.
        tile_size: of the tile data in `info`; what draws chooses its own.
        backgrounds: colours behind everything, D channels; depth has none.
        render_mode: "D" is accumulated depth, "ED" expected depth; "+": the last channel.
        absgrad: `info["means2d"].absgrad` is filled in by the backward pass.
        rasterize_mode: "antialiased" as in Mip-Splatting.
        channel_chunk, segmented: change nothing here.
        camera_model: "pinhole", "ortho" or "fisheye"; the last two always by the unscented
            transform, as `with_ut` asks it of a pinhole (see `hoigs.core.maths.optics`).
        radial_coeffs, tangential_coeffs, thin_prism_coeffs: OpenCV's; [*B, C, up to 6] and up to 4
            for a fisheye. They are read to the host, which waits for a GPU, and have no gradient.
        rolling_shutter, viewmats_rs: gsplat's `RollingShutterType`, or its name in lower case, and
            the pose while the last row (or column) is exposed.
        rasterizer: what draws; `WarpRasterizer()` by default.

    Returns:
        images, alphas, and `info` with the entries of gsplat's. `info["means2d"]` takes the
        screen-space gradient of the images, as density control needs it, but is itself no function
        of `means`. `radii` are three standard deviations along the longest axis, twice. `conics`,
        `opacities` and the tile data have no gradient, and are computed when they are first read.

    Raises:
        RenderError: an argument is not supported, or of a shape that does not fit.
    """
    others |= {"sparse_grad": sparse_grad, "distributed": distributed, "covars": covars}
    for name, value in others.items():
        if name not in UNSUPPORTED:
            raise TypeError(f"rasterization() got an unexpected keyword argument {name!r}")
        if value is not None and value is not False:
            raise RenderError(f"rasterization: {name} is not supported; leave it out")
    shutter = _shutter(rolling_shutter)
    bent = {
        "radial_coeffs": radial_coeffs,
        "tangential_coeffs": tangential_coeffs,
        "thin_prism_coeffs": thin_prism_coeffs,
        "viewmats_rs": viewmats_rs,
    }
    if not global_z_order:
        raise RenderError("rasterization: global_z_order=False is not supported; leave it out")
    for name, value in bent.items():
        if value is not None and not with_ut:
            raise RenderError(f"rasterization: {name} needs with_ut=True, as in gsplat")
    if (shutter == "global") != (viewmats_rs is None):
        raise RenderError(
            f"rasterization: rolling_shutter is {shutter!r} and viewmats_rs is "
            f"{'not ' * (viewmats_rs is not None)}None; a rolling shutter needs both"
        )
    for name, given, known in (
        ("camera_model", camera_model, get_args(Model)),
        ("render_mode", render_mode, MODES),
        ("rasterize_mode", rasterize_mode, ("classic", "antialiased")),
    ):
        if given not in known:
            raise RenderError(f"rasterization: {name} {given!r}, expected {' or '.join(known)}")
    batch, count, cameras = means.shape[:-2], means.shape[-2], viewmats.shape[-3]
    per_view = colors.dim() == len(batch) + (3 if sh_degree is None else 4)
    per_gaussian = {"means": (means, (3,)), "quats": (quats, (4,)), "scales": (scales, (3,))}
    _check_shapes(
        batch,
        {
            **{name: (value, (count, *last)) for name, (value, last) in per_gaussian.items()},
            "opacities": (opacities, (count,)),
            "colors": (colors, (*(cameras,) * per_view, count, *_color_shape(colors, sh_degree))),
            "viewmats": (viewmats, (cameras, 4, 4)),
            "Ks": (Ks, (cameras, 3, 3)),
            "viewmats_rs": (viewmats_rs, (cameras, 4, 4)),
            **{
                name: (value, (cameras, min(value.shape[-1], most)))
                for (name, value), most in zip(bent.items(), COEFFICIENTS[camera_model])
                if value is not None
            },
            "backgrounds": (
                backgrounds,
                (cameras, 3 if sh_degree is not None else colors.shape[-1]),
            ),
        },
    )
    rasterizer = rasterizer or _warp()
    scales = scales.clamp_min(torch.finfo(scales.dtype).tiny)
    raw = (means, quats, scales.log(), _Logit.apply(opacities), colors, viewmats, Ks)
    rows = [x.reshape(-1, *x.shape[len(batch) :]) for x in raw]
    optics: list[Optics | None] = [None] * (math.prod(batch) * cameras)
    if with_ut or camera_model != "pinhole":
        optics = _optics(camera_model, shutter, bent, len(optics))
    images = [(b, c) for b in range(math.prod(batch)) for c in range(cameras)]
    screen = _Screen(means, cameras, absgrad)
    views: list[_View] = []
    for image, (b, c) in enumerate(images):
        mean, quat, log_scale, logit, color, view, K = (x[b] for x in rows)
        views.append(
            _draw(
                rasterizer,
                Gaussians(mean, quat, log_scale, logit, mean.new_zeros(count, 1, 3)),
                color[c] if per_view else color,
                Camera(K[c], view[c], width, height, optics[image]),
                RenderRequest(
                    near=near_plane,
                    low_pass=eps2d,
                    antialiased=rasterize_mode == "antialiased",
                    screen_offsets=screen.offsets(image),
                    absolute_gradients=screen.absolute(image),
                ),
                sh_degree=sh_degree,
                colored="RGB" in render_mode,
                far_plane=far_plane,
                radius_clip=radius_clip,
            )
        )
    alphas = torch.stack([view.drawn.alpha for view in views])[..., None]
    parts = []
    if "RGB" in render_mode:
        rgb = torch.stack([view.colors for view in views])
        if backgrounds is not None:
            rgb = rgb + (1.0 - alphas) * backgrounds.reshape(len(images), 1, 1, -1)
        parts.append(rgb)
    if render_mode != "RGB":
        depth = torch.stack([view.drawn.depth for view in views])[..., None]
        parts.append(depth / alphas.clamp_min(1e-10) if "ED" in render_mode else depth)
    info = _Info(screen, views, (*batch, cameras, count), packed, tile_size)
    shape = (*batch, cameras, height, width, -1)
    return torch.cat(parts, -1).reshape(shape), alphas.reshape(shape), info


def _shutter(given: int | str) -> Shutter:
    """By gsplat's number, or by its name: "ROLLING_TOP_TO_BOTTOM" is "top_to_bottom"."""
    if isinstance(given, int) and 0 <= given < len(SHUTTERS):
        return SHUTTERS[given]
    for name in SHUTTERS:
        if str(given).lower().removeprefix("rolling_") == name:
            return name
    raise RenderError(
        f"rasterization: rolling_shutter {given!r}, expected one of {', '.join(SHUTTERS)}"
    )


def _optics(
    model: str, shutter: Shutter, bent: dict[str, Tensor | None], count: int
) -> list[Optics | None]:
    """Those of each image, in the order of batch and camera."""

    def numbers(name: str) -> list[tuple[float, ...]]:
        value = bent[name]
        if value is None:
            return [()] * count
        return [tuple(row) for row in value.detach().reshape(count, -1).tolist()]

    last = bent["viewmats_rs"]
    poses = [None] * count if last is None else list(last.reshape(count, 4, 4))
    columns = (numbers(f"{name}_coeffs") for name in ("radial", "tangential", "thin_prism"))
    return [
        Optics(cast(Model, model), k, p, s, shutter, pose)
        for k, p, s, pose in zip(*columns, poses, strict=True)
    ]


def _color_shape(colors: Tensor, sh_degree: int | None) -> tuple[int, ...]:
    """What `colors` holds for a Gaussian: D numbers, or K coefficients of three channels."""
    if sh_degree is None:
        return (colors.shape[-1],)
    if not 0 <= sh_degree <= 4:
        raise RenderError(f"rasterization: sh_degree {sh_degree} is outside 0..4")
    return (max(colors.shape[-2], (sh_degree + 1) ** 2), 3)


def _check_shapes(
    batch: torch.Size, expected: dict[str, tuple[Tensor | None, tuple[int, ...]]]
) -> None:
    for name, (value, shape) in expected.items():
        if value is not None and tuple(value.shape) != (*batch, *shape):
            raise RenderError(
                f"rasterization: {name} has shape {list(value.shape)}, expected {[*batch, *shape]}"
            )


@cache
def _warp() -> Rasterizer:
    from hoigs.rasterizers.warp import WarpRasterizer

    return WarpRasterizer()


class _Logit(torch.autograd.Function):
    """logit(opacity), finite at 0 and 1, so that both learn as in gsplat."""

    @staticmethod
    def forward(ctx: Any, opacities: Tensor) -> Tensor:
        edge = torch.finfo(opacities.dtype).eps
        kept = opacities.clamp(edge, 1.0 - edge)
        ctx.save_for_backward(kept)
        return torch.logit(kept)

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> Tensor:
        (kept,) = ctx.saved_tensors
        return upstream / (kept * (1.0 - kept))


class _Zeros(torch.autograd.Function):
    """Zeros of a tensor's shape, whose gradient is that tensor's."""

    @staticmethod
    def forward(ctx: Any, taker: Tensor) -> Tensor:
        return torch.zeros_like(taker)

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> Tensor:
        return upstream


class _Screen:
    """Projected means of all images, which take the gradients of places on screen.

    A rasterizer has screen offsets to take that gradient. They are zeros made of `means2d`, which
    is filled with the places once these have been drawn.
    """

    def __init__(self, means: Tensor, cameras: int, absgrad: bool) -> None:
        *batch, count, _ = means.shape
        self.means2d = means.new_zeros(*batch, cameras, count, 2)
        self._zeros = self._absolute = None
        if torch.is_grad_enabled():
            self.means2d.requires_grad_()
            self._zeros = _Zeros.apply(self.means2d).reshape(-1, count, 2)
            if absgrad:
                self._absolute = torch.zeros_like(self._zeros, requires_grad=True)

    def offsets(self, image: int) -> Tensor | None:
        return None if self._zeros is None else self._zeros[image]

    def absolute(self, image: int) -> Tensor | None:
        return None if self._absolute is None else self._absolute[image]

    def filled(self, places: Float[Tensor, "I N 2"], drawn: Bool[Tensor, "I N"] | None) -> Tensor:
        """`means2d` as `info` holds it: of all rows, or of those that are drawn."""
        taker = self.means2d
        with torch.no_grad():
            taker.copy_(places.reshape(taker.shape))
        if self._zeros is None or drawn is None:
            shown = taker if drawn is None else places[drawn]
        else:
            shown = places[drawn].requires_grad_()
            taker.register_post_accumulate_grad_hook(_giver(shown, "grad", drawn))
        if self._absolute is not None:
            self._absolute.register_post_accumulate_grad_hook(_giver(shown, "absgrad", drawn))
        return shown


def _giver(shown: Tensor, name: str, drawn: Bool[Tensor, "I N"] | None) -> Callable[[Tensor], None]:
    """Sets `shown.grad`, or another attribute, to the gradient that another tensor has taken."""

    def hook(taker: Tensor) -> None:
        assert taker.grad is not None
        part = taker.grad.reshape(shown.shape) if drawn is None else _rows(taker.grad, drawn)
        setattr(shown, name, part)

    return hook


def _rows(values: Tensor, drawn: Bool[Tensor, "I N"]) -> Tensor:
    return values.reshape(*drawn.shape, -1)[drawn]


@dataclass(frozen=True)
class _View:
    """One image, the colours in it, and what its rows are on screen, computed when called."""

    drawn: RenderOutput
    colors: Float[Tensor, "H W D"]
    projected: Callable[[], Projection]


def _draw(
    rasterizer: Rasterizer,
    raw: Gaussians,
    colors: Tensor,
    camera: Camera,
    request: RenderRequest,
    *,
    sh_degree: int | None,
    colored: bool,
    far_plane: float,
    radius_clip: float,
) -> _View:
    @cache
    @torch.no_grad()
    def projected() -> Projection:
        shape = (raw.means, raw.quats, raw.log_scales, raw.opacity_logits)
        return project(
            *shape, camera.world_to_camera, camera.K, camera.width, camera.height,
            optics=camera.optics, near=request.near, low_pass=request.low_pass,
            antialiased=request.antialiased,
        )  # fmt: skip

    subset = None
    if far_plane < LIMIT:
        view = camera.middle.world_to_camera.detach()
        subset = raw.means.detach() @ view[2, :3] + view[2, 3] <= far_plane
    if radius_clip > 0:
        wide = torch.zeros(len(raw), dtype=torch.bool, device=raw.means.device)
        rows = projected()
        wide[rows.index] = (_boxes(rows) > radius_clip).any(-1)
        subset = wide if subset is None else subset & wide
    features = None
    if colored and sh_degree is None:
        features = colors
    elif colored and sh_degree == 4:
        directions = torch.nn.functional.normalize(raw.means - camera.middle.center, dim=-1)
        bases = sh_basis(directions, 4)
        features = not_negative(0.5 + (bases[:, :, None] * colors[:, : bases.shape[1]]).sum(1))
    elif colored and sh_degree is not None:
        raw = raw.replace(sh=colors[:, : (sh_degree + 1) ** 2].contiguous())
    drawn = rasterizer.render(raw, camera, request.replace(features=features, subset=subset))
    return _View(drawn, drawn.color if drawn.features is None else drawn.features, projected)


def _boxes(rows: Projection) -> Float[Tensor, "M 2"]:
    """gsplat's radii: half width and height of the box where alpha can reach MIN_ALPHA, pixels."""
    reach = (2.0 * (rows.opacities / MIN_ALPHA).clamp_min(1.0).log()).sqrt().clamp_max(WIDEST_BOX)
    return (reach[:, None] * rows.covs[:, ::2].sqrt()).ceil()


class _Info(dict[str, Any]):
    """gsplat's `meta`. What few read is computed when it is first read."""

    def __init__(
        self, screen: _Screen, views: list[_View], shape: tuple[int, ...], packed: bool, tile: int
    ) -> None:
        height, width = views[0].drawn.alpha.shape
        *batch, cameras, _ = shape
        self._views, self._shape, self._tile = views, shape, tile
        told = {
            name: torch.stack([view.drawn.info[name] for view in views])
            for name in ("radii", "means2d", "depths")
        }
        radii = told["radii"].int()[..., None].expand(-1, -1, 2)
        self._drawn = told["radii"] > 0 if packed else None
        ids: tuple[Tensor | None, ...] = (None,) * 3
        if self._drawn is not None:
            image, gaussian = self._drawn.nonzero().unbind(1)
            ids = (image // cameras, image % cameras, gaussian)
        super().__init__(
            batch_ids=ids[0],
            camera_ids=ids[1],
            gaussian_ids=ids[2],
            radii=self._as_asked(radii),
            means2d=screen.filled(told["means2d"], self._drawn),
            depths=self._as_asked(told["depths"]),
            width=width,
            height=height,
            tile_size=tile,
            tile_width=-(-width // tile),
            tile_height=-(-height // tile),
            n_batches=math.prod(batch),
            n_cameras=cameras,
        )
        self._later: dict[str, Callable[[], dict[str, Tensor]]] = {
            **dict.fromkeys(("conics", "opacities"), self._on_screen),
            **dict.fromkeys(
                ("tiles_per_gauss", "isect_ids", "flatten_ids", "isect_offsets"), self._tiles
            ),
        }
        for name in self._later:
            super().__setitem__(name, None)

    def __getitem__(self, name: str) -> Any:
        if name in self._later:
            for key, value in self._later[name]().items():
                self[key] = value
        return super().__getitem__(name)

    def __setitem__(self, name: str, value: Any) -> None:
        self._later.pop(name, None)
        super().__setitem__(name, value)

    def get(self, name: str, default: Any = None) -> Any:
        return self[name] if name in self else default  # noqa: SIM401 - that is this

    def items(self) -> Any:
        return [(name, self[name]) for name in self]

    def values(self) -> Any:
        return [self[name] for name in self]

    def _as_asked(self, values: Float[Tensor, "I N *last"]) -> Tensor:
        if self._drawn is None:
            return values.reshape(*self._shape, *values.shape[2:])
        return values[self._drawn]

    def _spread(self, name: str) -> Tensor:
        """A field of the projections in the order of the input, zeros where a row is not drawn."""
        found = []
        for view in self._views:
            rows = view.projected()
            values = getattr(rows, name)
            found.append(values.new_zeros(self._shape[-1], *values.shape[1:]))
            found[-1][rows.index] = values
        return torch.stack(found)

    def _on_screen(self) -> dict[str, Tensor]:
        return {name: self._as_asked(self._spread(name)) for name in ("conics", "opacities")}

    def _tiles(self) -> dict[str, Tensor]:
        """Intersections of boxes with tiles, sorted by image, tile and depth, as gsplat's keys."""
        across, down, tile = self["tile_width"], self["tile_height"], self._tile
        counts, keys, rows_of = [], [], []
        for image, view in enumerate(self._views):
            rows = view.projected()
            limit = rows.means2d.new_tensor([across, down])
            half = _boxes(rows)
            first = ((rows.means2d - half) / tile).floor().clamp_min(0).minimum(limit).long()
            last = ((rows.means2d + half) / tile).ceil().clamp_min(0).minimum(limit).long()
            columns, lines = (last - first).unbind(1)
            number = columns * lines
            row = torch.repeat_interleave(number)
            nth = torch.arange(len(row), device=row.device) - (number.cumsum(0) - number)[row]
            y, x = first[row, 1] + nth // columns[row], first[row, 0] + nth % columns[row]
            depth = rows.depths[row].float().view(torch.int32).long()  # positive: ordered as bits
            bits = (across * down).bit_length()
            keys.append(image << (32 + bits) | (y * across + x) << 32 | depth)
            rows_of.append(image * self._shape[-1] + rows.index[row])
            counts.append(rows.index.new_zeros(self._shape[-1]).index_put((rows.index,), number))
        key, order = torch.cat(keys).sort(stable=True)
        flat = torch.cat(rows_of)[order]
        if self._drawn is not None:  # numbers among what is drawn
            flat = (self._drawn.flatten().cumsum(0) - 1)[flat]
        bits = (across * down).bit_length()
        images = torch.arange(len(self._views), device=key.device)[:, None] << bits
        starts = (images | torch.arange(across * down, device=key.device)) << 32
        offsets = torch.searchsorted(key, starts.flatten())
        return {
            "tiles_per_gauss": self._as_asked(torch.stack(counts)).int(),
            "isect_ids": key,
            "flatten_ids": flat.int(),
            "isect_offsets": offsets.int().reshape(*self._shape[:-1], down, across),
        }
