"""Rasterizer: Gaussians and a camera in, an image with alpha, depth and features out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.errors import RenderError
from hoigs.core.interfaces.configurable import Configurable
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians

# all that `Camera.optics` may need of a rasterizer
OPTICS = frozenset({"unscented", "ortho", "fisheye", "distortion", "rolling_shutter"})


@dataclass(frozen=True)
class Capabilities:
    """What a backend can do, as conformance tests and `hoigs doctor` read it.

    Attributes:
        devices: torch device types. dtypes: names of the floating types it computes in.
        camera_gradients: whether gradients reach `Camera.world_to_camera`.
        deterministic: whether two runs agree bit for bit.
        absolute_gradients: whether `RenderRequest.absolute_gradients` is filled in.
        optics: what of `Camera.optics` it draws: "unscented", "ortho", "fisheye", "distortion",
            "rolling_shutter"; nothing: pinholes with a global shutter only.
        fixed: options of a request that the backend cannot change, with their only value.
        image_error: largest error of an image against float64 away from cut-offs (depth: in parts
            of its largest value).
        gradient_error: largest relative L2 error of a gradient, to the same reference.
    """

    devices: frozenset[str]
    dtypes: frozenset[str]
    camera_gradients: bool
    deterministic: bool
    absolute_gradients: bool = False
    optics: frozenset[str] = frozenset()
    fixed: Mapping[str, float] = field(default_factory=dict, hash=False)
    image_error: float = 1e-5
    gradient_error: float = 1e-4


@dataclass(frozen=True)
class RenderRequest:
    """What to draw, and by which rules.

    Attributes:
        features: extra channels composited like colour, any F.
        subset: rows to draw (boolean mask); others neither show nor occlude.
        background: colour behind everything, RGB in [0, 1] (a colour or an image); black when None.
        sh_degree: highest degree of spherical harmonics to use, 0..3; None is the stored degree.
        screen_offsets: added to the projected means, pixels. A zero tensor that requires grad
            receives the screen-space gradient that density control needs, on every backend alike.
        absolute_gradients: does not change the picture, whatever its values. A tensor that requires
            grad receives for each Gaussian the sum over pixels p of (|dL_p / du|, |dL_p / dv|),
            where (u, v) is its projected mean and L_p the part of the loss from pixel p, all
            channels together, so that gradients of opposite sign do not cancel (AbsGS, Ye et al.
            2024, arXiv:2404.10484). Needs `Capabilities.absolute_gradients`.
        near: Gaussians whose centre is nearer than this are culled, metres.
        low_pass: variance added to the screen covariance, square pixels (3DGS: 0.3).
        antialiased: multiply each opacity by the share of its area on screen that was there before
            `low_pass` was added, so that a Gaussian of less than a pixel fades rather than grows,
            and a picture of any size has the same brightness (Mip-Splatting, Yu et al. 2024,
            arXiv:2311.16493, eq. 9; "antialiased" in gsplat). 3DGS: False.
        max_alpha: alpha of one Gaussian at one pixel is clamped to this (no gradient above).
        min_alpha: contributions below are skipped (3DGS: 1/255).
        min_transmittance: compositing stops before transmittance falls to this (3DGS: 1e-4).
    """

    features: Float[Tensor, "N F"] | None = None
    subset: Tensor | None = None
    background: Tensor | None = None
    sh_degree: int | None = None
    screen_offsets: Float[Tensor, "N 2"] | None = None
    absolute_gradients: Float[Tensor, "N 2"] | None = None
    near: float = 0.05
    low_pass: float = 0.3
    antialiased: bool = False
    max_alpha: float = 0.999
    min_alpha: float = 1.0 / 255.0
    min_transmittance: float = 1e-4

    def replace(self, **changes: Any) -> RenderRequest:
        return replace(self, **changes)


@dataclass(frozen=True)
class RenderOutput:
    """One drawn view.

    Attributes:
        color: RGB over the background, not clamped.
        alpha: accumulated opacity.
        depth: accumulated depth sum(w z), metres; see `expected_depth`.
        features: accumulated features sum(w f), or None if the request has none.
        info: `radii` [N] (pixels, 0 when culled) and what a backend adds.
    """

    color: Float[Tensor, "H W 3"]
    alpha: Float[Tensor, "H W"]
    depth: Float[Tensor, "H W"]
    features: Float[Tensor, "H W F"] | None = None
    info: dict[str, Any] = field(default_factory=dict)

    @property
    def expected_depth(self) -> Float[Tensor, "H W"]:
        """depth / alpha, metres: the mean depth of what is seen; 0 where nothing is."""
        return self.depth / self.alpha.clamp_min(1e-6)


class Rasterizer(Configurable, ABC):
    """A splatting backend. Results depend on the inputs alone; it never falls back to another.

    One whose renders and gradients a CUDA graph may hold declares `cuda_graph_safe = True` in its
    own class (`hoigs.core.fast.graphs`).
    """

    capabilities: Capabilities

    @abstractmethod
    def render(
        self, gaussians: Gaussians, camera: Camera, request: RenderRequest | None = None
    ) -> RenderOutput:
        """Draw. Gradients reach every raw field, `features`, `screen_offsets` and `background`.

        Gaussians that are culled (behind `near`, off screen, not finite, zero quaternion, outside
        `subset`) contribute nothing, get zero gradients and change no other Gaussian's.

        Raises:
            RenderError: shapes, dtypes, devices or limits that this backend cannot draw.
        """

    def graph_memory(self, device: torch.device) -> int:
        """How much memory a render that is captured in a CUDA graph now would be given; a graph of
        before is captured anew when this number changes. 0 where it does not change."""
        del device
        return 0

    def check_inputs(self, gaussians: Gaussians, camera: Camera, request: RenderRequest) -> None:
        """The checks that every backend shares; call first in `render`."""
        name = type(self).__name__
        for key, passed, kind in (
            ("gaussians", gaussians, Gaussians),
            ("camera", camera, Camera),
            ("request", request, RenderRequest),
        ):
            if not isinstance(passed, kind):
                raise RenderError(
                    f"{name}: {key} is of type {type(passed).__name__}, expected {kind.__name__}; "
                    "the order is render(gaussians, camera, request)"
                )
        device = gaussians.means.device
        if device.type not in self.capabilities.devices:
            raise RenderError(
                f"{name}: Gaussians are on {device}, expected one of "
                f"{sorted(self.capabilities.devices)}; move them with gaussians.to(...)"
            )
        dtype = str(gaussians.means.dtype).removeprefix("torch.")
        if dtype not in self.capabilities.dtypes:
            raise RenderError(
                f"{name}: computes in {sorted(self.capabilities.dtypes)}, means are {dtype}"
            )
        if camera.width < 1 or camera.height < 1:
            raise RenderError(f"{name}: image size {camera.width}x{camera.height} is empty")
        needed = frozenset() if camera.optics is None else camera.optics.needs
        if missing := sorted(needed - self.capabilities.optics):
            raise RenderError(
                f"{name}: cannot draw a camera with {' and '.join(missing)} (camera.optics); "
                "use a rasterizer that can, for example rasterizer:warp"
            )
        if request.absolute_gradients is not None and not self.capabilities.absolute_gradients:
            raise RenderError(
                f"{name}: cannot compute absolute screen gradients (request.absolute_gradients); "
                "use a rasterizer that can, for example rasterizer:warp"
            )
        for key, (value, shapes) in _expected_shapes(gaussians, camera, request).items():
            if value is None:
                continue
            if not any(_matches(value.shape, shape) for shape in shapes):
                good = " or ".join(_shape_text(shape) for shape in shapes)
                raise RenderError(
                    f"{name}: {key} has shape {_shape_text(tuple(value.shape))}, expected {good}"
                )
            if value.device != device:
                raise RenderError(
                    f"{name}: {key} is on {value.device}, gaussians.means on {device}; "
                    "move one with .to(...)"
                )
            if key.startswith("gaussians.") and value.dtype != gaussians.means.dtype:
                raise RenderError(f"{name}: {key} is {value.dtype}, gaussians.means are {dtype}")
        if request.subset is not None and request.subset.dtype != torch.bool:
            raise RenderError(f"{name}: request.subset must be a boolean mask")
        degree = request.sh_degree
        if degree is not None and not 0 <= degree <= 3:
            raise RenderError(f"{name}: sh_degree {degree} is outside 0..3")
        limits = {
            "near": (request.near >= 0, "0 or more metres"),
            "low_pass": (request.low_pass >= 0, "0 or more square pixels"),
            "max_alpha": (0 < request.max_alpha <= 1, "above 0 and at most 1"),
            "min_alpha": (0 <= request.min_alpha <= request.max_alpha, "from 0 to max_alpha"),
            "min_transmittance": (0 <= request.min_transmittance < 1, "at least 0 and below 1"),
        }
        for key, (valid, expected) in limits.items():
            if not valid:
                raise RenderError(
                    f"{name}: request.{key} is {getattr(request, key)}, expected {expected}"
                )
        for key, only in self.capabilities.fixed.items():
            if getattr(request, key) != only:
                raise RenderError(
                    f"{name}: request.{key} is {getattr(request, key)}; this backend can only "
                    f"draw with {key} = {only}"
                )


Shape = tuple[int | None, ...]  # None is any number


def _expected_shapes(
    gaussians: Gaussians, camera: Camera, request: RenderRequest
) -> dict[str, tuple[Tensor | None, list[Shape]]]:
    count = gaussians.means.shape[0] if gaussians.means.dim() else 0
    image = (camera.height, camera.width, 3)
    return {
        "gaussians.means": (gaussians.means, [(count, 3)]),
        "gaussians.quats": (gaussians.quats, [(count, 4)]),
        "gaussians.log_scales": (gaussians.log_scales, [(count, 3)]),
        "gaussians.opacity_logits": (gaussians.opacity_logits, [(count,)]),
        "gaussians.sh": (gaussians.sh, [(count, bands, 3) for bands in (1, 4, 9, 16)]),
        "camera.K": (camera.K, [(3, 3)]),
        "camera.world_to_camera": (camera.world_to_camera, [(4, 4)]),
        "camera.optics.last_world_to_camera": (
            None if camera.optics is None else camera.optics.last_world_to_camera,
            [(4, 4)],
        ),
        "request.features": (request.features, [(count, None)]),
        "request.subset": (request.subset, [(count,)]),
        "request.screen_offsets": (request.screen_offsets, [(count, 2)]),
        "request.absolute_gradients": (request.absolute_gradients, [(count, 2)]),
        "request.background": (request.background, [(3,), image]),
    }


def _matches(actual: torch.Size, expected: Shape) -> bool:
    return len(actual) == len(expected) and all(
        limit is None or size == limit for size, limit in zip(actual, expected)
    )


def _shape_text(shape: Shape) -> str:
    return "[" + ", ".join("any" if size is None else str(size) for size in shape) + "]"
