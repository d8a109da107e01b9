"""From the values that users hold to what the kernels take."""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor

from hoigs.core.camera import Camera
from hoigs.core.gaussians import Gaussians
from hoigs.core.rasterizer import Rasterizer, RenderRequest
from hoigs.rasterizers.warp.frame import Settings, check_addressable

MOST_KNOWN = 256


class Door:
    """Where the inputs of a rasterizer are checked and made ready for its kernels.

    All that is checked are shapes, types and numbers, and a training repeats them: what passed once
    is known again by those, in a tenth of the time.
    """

    def __init__(self) -> None:
        self._known: dict[Any, Settings] = {}

    def prepare(
        self, rasterizer: Rasterizer, gaussians: Gaussians, camera: Camera, request: RenderRequest
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
        settings = self._known.get(key)
        if settings is None:
            rasterizer.check_inputs(gaussians, camera, request)
            settings = _settings(gaussians, camera, request)
            if len(self._known) >= MOST_KNOWN:
                self._known.clear()
            self._known[key] = settings
        return settings, _tensors(gaussians, camera, request)


def _settings(gaussians: Gaussians, camera: Camera, request: RenderRequest) -> Settings:
    stored, degree = gaussians.sh.shape[1], request.sh_degree
    channels = 0 if request.features is None else request.features.shape[1]
    check_addressable(
        camera.width * camera.height * max(3, channels),
        f"{camera.width}x{camera.height} pixels with {channels} feature channels",
    )
    return Settings(
        width=camera.width,
        height=camera.height,
        bands=stored if degree is None else min(stored, (degree + 1) ** 2),
        near=request.near,
        low_pass=request.low_pass,
        max_alpha=request.max_alpha,
        min_alpha=request.min_alpha,
        min_transmittance=request.min_transmittance,
    )


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
        _none(like.device, 2) if offsets is None else offsets,
        _black(like) if background is None else background,
        camera.world_to_camera,
        camera.K,
    ]
    tensors = [
        x if x.dtype == torch.float32 and x.is_contiguous() else x.float().contiguous()
        for x in tensors
    ]
    if subset is None:
        return [*tensors, _no_subset(like.device)]
    return [*tensors, subset.contiguous().view(torch.uint8)]


def _black(like: Tensor) -> Tensor:
    if like.is_cuda and torch.cuda.is_current_stream_capturing():
        return like.new_zeros(3)  # of the graph's own: its memory is not for others
    return _kept_black(like.device)


@functools.cache
def _kept_black(device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        return torch.zeros(3, device=device)


@functools.cache
def _none(device: torch.device, width: int) -> Tensor:
    with torch.inference_mode(False):
        return torch.empty(0, width, device=device)


@functools.cache
def _no_subset(device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        return torch.empty(0, dtype=torch.uint8, device=device)
