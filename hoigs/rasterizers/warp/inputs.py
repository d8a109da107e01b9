"""From the values that users hold to what the kernels take."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from hoigs.core.camera import Camera
from hoigs.core.errors import RenderError
from hoigs.core.gaussians import Gaussians
from hoigs.core.rasterizer import Rasterizer, RenderRequest
from hoigs.rasterizers.warp.frame import Settings, check_addressable


@functools.cache
def black(device: torch.device) -> Tensor:
    return torch.zeros(3, device=device)


def prepare(
    rasterizer: Rasterizer, gaussians: Gaussians, camera: Camera, request: RenderRequest
) -> tuple[Settings, list[Tensor]]:
    """Settings, and tensors in the order of `frame.Inputs`: contiguous, absent ones empty.

    Raises:
        RenderError: input that cannot be drawn.
    """
    rasterizer.check_inputs(gaussians, camera, request)
    like = gaussians.means
    count, stored = gaussians.sh.shape[:2]
    degree = request.sh_degree
    settings = Settings(
        width=camera.width,
        height=camera.height,
        bands=stored if degree is None else min(stored, (degree + 1) ** 2),
        near=request.near,
        low_pass=request.low_pass,
        max_alpha=request.max_alpha,
        min_alpha=request.min_alpha,
        min_transmittance=request.min_transmittance,
    )
    if request.near < 0:
        raise RenderError(f"WarpRasterizer: near is {request.near}, expected 0 or more (metres)")
    channels = 0 if request.features is None else request.features.shape[1]
    check_addressable(
        camera.width * camera.height * max(3, channels),
        f"{camera.width}x{camera.height} pixels with {channels} feature channels",
    )
    background = black(like.device) if request.background is None else request.background
    features, offsets, subset = request.features, request.screen_offsets, request.subset
    tensors = [
        gaussians.means,
        gaussians.quats,
        gaussians.log_scales,
        gaussians.opacity_logits,
        gaussians.sh,
        like.new_empty(count, 0) if features is None else features,
        like.new_empty(0, 2) if offsets is None else offsets,
        background,
        camera.world_to_camera,
        camera.K,
    ]
    tensors = [x.to(like).contiguous() for x in tensors]
    if subset is None:
        tensors.append(like.new_empty(0, dtype=torch.uint8))
    else:
        tensors.append(subset.contiguous().view(torch.uint8))
    return settings, tensors
