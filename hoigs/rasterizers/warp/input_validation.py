"""From the values that users hold to the tensors that kernels take."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.rasterizers.warp.common.frame import Settings, check_addressable

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
        key = tuple(
            (x.shape, x.dtype, x.device) if isinstance(x, Tensor) else x
            for value in (gaussians, camera, request)
            for x in vars(value).values()
        )
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
        min_transmittance=request.min_transmittance,
    )  # fmt: skip


def _tensors(gaussians: Gaussians, camera: Camera, request: RenderRequest) -> list[Tensor]:
    like = gaussians.means
    background, subset = request.background, request.subset
    features, offsets = request.features, request.screen_offsets
    tensors = [
        like,
        gaussians.quats,
        gaussians.log_scales,
        gaussians.opacity_logits,
        gaussians.sh,
        like.new_empty(like.shape[0], 0) if features is None else features,
        _constant(like.device, 0, 2) if offsets is None else offsets,
        _black(like) if background is None else background,
        camera.world_to_camera,
        camera.K,
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


def _black(like: Tensor) -> Tensor:
    if like.is_cuda and torch.cuda.is_current_stream_capturing():
        return like.new_zeros(3)  # memory of the graph, which others must not use
    return _constant(like.device, 3)


@functools.cache
def _constant(device: torch.device, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """Zeros, or nothing, that every render on a device shares."""
    with torch.inference_mode(False):
        return torch.zeros(shape, device=device, dtype=dtype)
