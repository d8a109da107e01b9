"""The settings and tensors of one render, as all devices share them."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from hoigs.core.errors import RenderError
from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.core.maths.optics import MODELS, Model, Optics
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians

INT32 = 2**31 - 1
MOTION = 6  # turn and shift of a rolling shutter


@dataclass(frozen=True)
class Settings:
    """What is no tensor in one render; see `RenderRequest` for most of it.

    Attributes:
        active_bases: how many SH basis functions are used: 1, 4, 9 or 16.
        optics: whether the camera has some: other kernels project.
    """

    width: int
    height: int
    active_bases: int
    near: float
    low_pass: float
    antialiased: bool
    max_alpha: float
    min_alpha: float
    min_transmittance: float
    optics: bool


@dataclass(frozen=True)
class Inputs:
    """Contiguous float32 tensors of one render on one device; absent ones are empty.

    Attributes:
        means [N, 3], quats [N, 4], log_scales [N, 3], opacity_logits [N], sh [N, K, 3]: raw space.
        features [N, F], absent [0, 0]; screen_offsets [N, 2] pixels; subset [N] uint8.
        absolute_gradients [N, 2]: receives them; its values are not read.
        background: [3] or [H, W, 3].
        world_to_camera [4, 4], K [3, 3]: of the camera; with optics the pose in the middle of the
            exposure, and for K `camera_numbers`.
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    sh: Tensor
    features: Tensor
    screen_offsets: Tensor
    background: Tensor
    world_to_camera: Tensor
    K: Tensor
    subset: Tensor
    absolute_gradients: Tensor

    @property
    def count(self) -> int:
        return self.means.shape[0]

    @property
    def channels(self) -> int:
        return self.features.shape[1]


@dataclass(frozen=True)
class TileIntersections:
    """The Gaussians of each tile, nearest first; on CUDA once they have been blended.

    Attributes:
        tile_height: pixels; tiles_x, tiles_y: number of tiles.
        offsets: [tiles + 1] int32, the first intersection of each tile. On CUDA more follows, see
            `intersect.cuda_kernels`.
        indices: [M, 2] int32, of each intersection the Gaussian and the partial (`common.records`).
        first_partial: [N] int32, the first partial of each Gaussian.
        tiles_per_gaussian: [N] int32, how many tiles, and so partials, each Gaussian has.
        keys, owners: what `blend` sorts on CUDA, see `intersect.cuda_kernels`; for it alone.
        counted: what `cuda.intersections` needs to add the other Gaussians to the nearest.
    """

    tile_height: int
    tiles_x: int
    tiles_y: int
    offsets: Tensor
    indices: Tensor
    first_partial: Tensor
    tiles_per_gaussian: Tensor
    keys: Tensor | None = None
    owners: Tensor | None = None
    counted: list[Any] | None = None

    @property
    def tiles(self) -> int:
        return self.tiles_x * self.tiles_y

    @property
    def count(self) -> int:
        """Intersections for which there is memory; on a CPU, how many there are."""
        return self.indices.shape[0]


@dataclass(frozen=True)
class Images:
    """color [H, W, 3] over the background, alpha [H, W], depth [H, W], features [H, W, F]."""

    color: Tensor
    alpha: Tensor
    depth: Tensor
    features: Tensor

    @staticmethod
    def empty(inputs: Inputs, settings: Settings) -> Images:
        size, new = (settings.height, settings.width), inputs.means.new_empty
        return Images(new(*size, 3), new(size), new(size), new(*size, inputs.channels))


def check_addressable(numbers: int, what: str) -> None:
    """Raise where kernels cannot address so many numbers with their 32-bit indices.

    Raises:
        RenderError: too many.
    """
    if numbers > INT32:
        raise RenderError(
            f"WarpRasterizer: {what} make {numbers} numbers, more than {INT32}, the most in one "
            "render; render parts of the image (Camera.cropped), or fewer channels at a time"
        )


# From the values that users hold to the tensors that kernels take.

CACHE_SIZE = 256


class InputValidation:
    """Checks the inputs of a rasterizer and prepares them for its kernels.

    The checks look at shapes, types and numbers only, and training repeats these. So what passed
    once is cached by them, which takes a tenth of the time of the checks.

    Args:
        check: raises RenderError where the inputs cannot be drawn.
    """

    def __init__(self, check: Callable[[Gaussians, Camera, RenderRequest], None]) -> None:
        self._check = check
        self._passed: dict[Any, Settings] = {}

    def prepare(
        self, gaussians: Gaussians, camera: Camera, request: RenderRequest
    ) -> tuple[Settings, list[Tensor]]:
        """Settings, and tensors in the order of `frame.Inputs`: contiguous, absent ones empty.

        Raises:
            RenderError: input that cannot be drawn.
        """
        optics = getattr(camera, "optics", None)
        plain = camera if optics is None else replace(camera, optics=None)
        key: tuple[Any, ...] = tuple(
            [  # not a generator, which takes half as long again
                (x.shape, x.dtype, x.device) if isinstance(x, Tensor) else x
                for value in (gaussians, plain, request)
                for x in getattr(value, "__dict__", {}).values()  # the check names other types
            ]
        )
        if optics is not None:
            pose = optics.last_world_to_camera
            key += (optics.needs, None if pose is None else (pose.shape, pose.device))
        settings = self._passed.get(key)
        if settings is None:
            self._check(gaussians, camera, request)
            settings = _settings(gaussians, camera, request)
            if len(self._passed) >= CACHE_SIZE:
                self._passed.clear()
            self._passed[key] = settings
        return settings, _tensors(gaussians, camera, request)


def _settings(gaussians: Gaussians, camera: Camera, request: RenderRequest) -> Settings:
    stored, degree = gaussians.sh.shape[1], request.sh_degree
    channels = 0 if request.features is None else request.features.shape[1]
    check_addressable(
        camera.width * camera.height * max(3, channels),
        f"{camera.width}x{camera.height} pixels with {channels} feature channels",
    )
    return Settings(
        width=camera.width, height=camera.height,
        active_bases=stored if degree is None else min(stored, (degree + 1) ** 2),
        near=request.near, low_pass=request.low_pass, antialiased=request.antialiased,
        max_alpha=request.max_alpha, min_alpha=request.min_alpha,
        min_transmittance=request.min_transmittance, optics=camera.optics is not None,
    )  # fmt: skip


def _tensors(gaussians: Gaussians, camera: Camera, request: RenderRequest) -> list[Tensor]:
    like = gaussians.means
    background, subset = request.background, request.subset
    features, offsets = request.features, request.screen_offsets
    pose, numbers = camera.world_to_camera, camera.K
    if camera.optics is not None:
        pose, numbers = camera_numbers(camera, camera.optics)
    tensors = [
        like,
        gaussians.quats,
        gaussians.log_scales,
        gaussians.opacity_logits,
        gaussians.sh,
        _constant(like.device, 0, 0) if features is None else features,
        _constant(like.device, 0, 2) if offsets is None else offsets,
        _black(like) if background is None else background,
        pose,
        numbers,
    ]
    tensors = [
        x if x.dtype == torch.float32 and x.is_contiguous() else x.float().contiguous()
        for x in tensors
    ]
    drawn = _constant(like.device, 0, dtype=torch.uint8)
    if subset is not None:
        drawn = subset.contiguous().view(torch.uint8)
    absolutes = request.absolute_gradients
    return [*tensors, drawn, _constant(like.device, 0, 2) if absolutes is None else absolutes]


def camera_numbers(camera: Camera, optics: Optics) -> tuple[Tensor, Tensor]:
    """The pose in the middle of the exposure, and K with all that `project.optics` reads beside it.

    Of the numbers only the motion has a gradient, as K has none.
    """
    pose, motion = optics.middle(camera.world_to_camera.double())
    fixed = _optics_numbers(
        optics.model, optics.coefficients, optics.largest_slope, motion is not None,
        optics.row_time(camera.width, camera.height), camera.K.device,
    )  # fmt: skip
    parts = [camera.K.detach().flatten(), fixed]
    return pose, torch.cat([*parts, fixed[:MOTION] if motion is None else motion])


@functools.lru_cache(maxsize=CACHE_SIZE)
def _optics_numbers(
    model: Model,
    coefficients: tuple[float, ...],
    largest_slope: float,
    moves: bool,
    row_time: tuple[float, float, float],
    device: torch.device,
) -> Tensor:
    numbers = [MODELS.index(model), *coefficients, largest_slope, moves, *row_time]
    with torch.inference_mode(False):
        return torch.tensor(numbers, dtype=torch.float64, device=device)


def _black(like: Tensor) -> Tensor:
    if like.is_cuda and torch.cuda.is_current_stream_capturing():
        return like.new_zeros(3)  # memory of the graph, which others must not use
    return _constant(like.device, 3)


@functools.cache
def _constant(device: torch.device, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """Zeros, or nothing, that every render on a device shares."""
    with torch.inference_mode(False):
        return torch.zeros(shape, device=device, dtype=dtype)
