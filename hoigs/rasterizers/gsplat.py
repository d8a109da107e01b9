"""gsplat's CUDA kernels (Ye et al. 2024, arXiv 2409.06765) as a rasterizer; extra `gsplat`.

Of gsplat 1.5.3 it calls the four operations that its `rasterization` is made of, because that
function offers no place for screen offsets and either spherical harmonics or features, not both.
The facts that matter, read from its sources:

  - quats are wxyz of any length, scales and opacities activated, means in world metres; its clamp
    of the Jacobian, pixel centres, order of the harmonics and `eps2d` (our low_pass) are those of
    `hoigs.core.maths.projection`.
  - Constants in its kernels: an alpha is clamped to 0.999, skipped below 1/255, and compositing
    stops before the transmittance falls to 1e-4. `Capabilities.fixed` declares them.
  - Gradients reach means, quats, scales, opacities, colours and the view matrix, not K. They are
    summed by atomics, so that two runs may differ in the last bits.
  - A row of NaN, or one that overflows, makes every pixel of its tiles NaN, and without any row
    it divides by zero on the host; so rows are filtered here, and gsplat is not called without any.
  - Its projection culls off the image before offsets could act; with offsets that are not all
    zero, `hoigs.core.maths.projection` takes its place.
"""

from __future__ import annotations

import inspect
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import RenderError
from hoigs.core.interfaces.rasterizer import Capabilities, Rasterizer, RenderOutput, RenderRequest
from hoigs.core.maths.projection import LIMIT, Projection
from hoigs.core.maths.spherical_harmonics import not_negative
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.rasterizers.compositing import project_gaussians, to_output

TILE = 16  # pixels; gsplat tests no other
CHANNELS_AT_ONCE = 32  # more need more shared memory in its backward kernel than a block has


class GsplatConfig(ComponentConfig):
    """Nothing to set."""


class GsplatRasterizer(Rasterizer):
    """Draws with gsplat on CUDA, by the rules of `hoigs.core.maths.projection` and its constants.

    gsplat compiles its kernels at the first render (minutes, once a machine; it needs nvcc). It
    cannot change `max_alpha`, `min_alpha` and `min_transmittance`.

    Raises:
        RenderError: gsplat or a CUDA device is missing, or gsplat cannot do what is requested.
    """

    capabilities = Capabilities(
        devices=frozenset({"cuda"}),
        dtypes=frozenset({"float32"}),
        camera_gradients=True,
        deterministic=False,
        fixed={"max_alpha": 0.999, "min_alpha": 1.0 / 255.0, "min_transmittance": 1e-4},
    )

    def render(
        self, gaussians: Gaussians, camera: Camera, request: RenderRequest | None = None
    ) -> RenderOutput:
        """Draw in float32; see `Rasterizer.render`."""
        request = request or RenderRequest()
        device = gaussians.means.device.type
        if device not in self.capabilities.devices and not torch.cuda.is_available():
            raise RenderError(
                f"GsplatRasterizer draws on CUDA only; the Gaussians are on {device}, and torch "
                "sees no CUDA device here: use rasterizer:warp or rasterizer:torch"
            )
        self.check_inputs(gaussians, camera, request)
        camera = camera.to(torch.float32)
        gsplat = _import_gsplat()
        offsets = request.screen_offsets
        moved = offsets is not None and bool(offsets.any())
        with torch.set_grad_enabled(moved and torch.is_grad_enabled()):
            shown = project_gaussians(gaussians, camera, request)
        rows = gaussians[shown.index]
        if len(shown) == 0:
            blended = _nothing(rows, camera, request, shown.index)
        else:
            blended = _blend(gsplat, rows, camera, request, shown, moved)
        return to_output(blended, camera, request, _report(shown, len(gaussians)))


def _import_gsplat() -> Any:
    try:
        import gsplat
    except ImportError as error:
        raise RenderError(
            f"GsplatRasterizer needs gsplat ({error}): pip install 'hoigs[gsplat]'"
        ) from error
    if "viewmats" in inspect.signature(gsplat.spherical_harmonics).parameters:
        raise RenderError(
            f"GsplatRasterizer draws with gsplat 1.5.3; {gsplat.__version__} is installed, which "
            "clamps an alpha to 0.99 instead of 0.999: pip install 'gsplat<1.6'"
        )
    return gsplat


def _blend(
    gsplat: Any,
    rows: Gaussians,
    camera: Camera,
    request: RenderRequest,
    shown: Projection,
    moved: bool,
) -> Float[Tensor, "P D"]:
    """Alpha, RGB, depth and features of every pixel, from the rows that are drawn."""
    if moved:
        means2d, depths, conics = shown.means2d, shown.depths, shown.conics
        opacities, radii = shown.opacities, shown.extents.ceil().int()
    else:
        opacities = rows.opacities
        radii, means2d, depths, conics, kept = gsplat.fully_fused_projection(
            rows.means,
            None,
            rows.quats,
            rows.scales,
            camera.world_to_camera[None],
            camera.K[None],
            camera.width,
            camera.height,
            eps2d=request.low_pass,
            near_plane=request.near,
            far_plane=LIMIT,
            calc_compensations=request.antialiased,
            opacities=opacities,
        )
        radii, means2d, depths, conics = radii[0], means2d[0], depths[0], conics[0]
        if request.antialiased:  # unset where gsplat's tighter box leaves a row out
            opacities = opacities * torch.where((radii > 0).all(-1), kept[0], 0.0)
        if request.screen_offsets is not None:  # zeros that take the screen-space gradient
            means2d = means2d + request.screen_offsets[shown.index].to(means2d)
    channels = [_colors(gsplat, rows, camera, request), depths[:, None]]
    if request.features is not None:
        channels.append(request.features[shown.index].to(depths))
    tiles_x, tiles_y = (-(-size // TILE) for size in (camera.width, camera.height))
    _, keys, members = gsplat.isect_tiles(
        means2d[None], radii[None], depths[None], TILE, tiles_x, tiles_y
    )
    starts = gsplat.isect_offset_encode(keys, 1, tiles_x, tiles_y)
    drawn = [
        gsplat.rasterize_to_pixels(
            means2d[None],
            conics[None],
            part[None],
            opacities[None],
            camera.width,
            camera.height,
            TILE,
            starts,
            members,
        )
        for part in torch.cat(channels, -1).split(CHANNELS_AT_ONCE, dim=-1)
    ]
    alpha = drawn[0][1]  # the same in all parts
    return torch.cat([alpha, *(image for image, _ in drawn)], -1)[0].flatten(0, 1)


def _colors(
    gsplat: Any, rows: Gaussians, camera: Camera, request: RenderRequest
) -> Float[Tensor, "M 3"]:
    """RGB as seen from the camera, by gsplat's harmonics."""
    stored = rows.sh_degree
    degree = stored if request.sh_degree is None else min(request.sh_degree, stored)
    values = gsplat.spherical_harmonics(degree, rows.means - camera.center, rows.sh)
    return not_negative(values + 0.5)


def _nothing(
    rows: Gaussians, camera: Camera, request: RenderRequest, index: Int[Tensor, " 0"]
) -> Float[Tensor, "P D"]:
    """Zeros at every pixel, tied to the graph so that every input gets a zero gradient."""
    tied = [rows.means, rows.quats, rows.log_scales, rows.opacity_logits, rows.sh]
    tied += [camera.world_to_camera[:0]]
    tied += [x[index] for x in (request.features, request.screen_offsets) if x is not None]
    features = 0 if request.features is None else request.features.shape[1]
    blank = rows.means.new_zeros(camera.height * camera.width, 5 + features)
    return blank + sum(x.sum() for x in tied).to(blank)  # type: ignore[union-attr]


@torch.no_grad()
def _report(shown: Projection, count: int) -> dict[str, Tensor]:
    """`info` in the order of the input, zeros where a row is not drawn."""
    return {
        name: values.new_zeros(count, *values.shape[1:]).index_copy(0, shown.index, values)
        for name in ("radii", "means2d", "depths")
        for values in (getattr(shown, name).detach(),)
    }
