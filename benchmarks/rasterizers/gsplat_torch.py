"""gsplat's torch reference, as far as it runs without CUDA.

As shipped it does not: its rasterizer takes the list of (pixel, Gaussian) hits from a CUDA kernel,
and `accumulate` calls nerfacc, whose scan is CUDA too. Measured are the functions that do run,
`_quat_scale_to_covar_preci`, `_fully_fused_projection`, `_spherical_harmonics` and `accumulate`,
with the list of hits given free and nerfacc's two functions replaced by torch's own operations.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import sys
from types import ModuleType
from typing import Any
from unittest import mock

import torch
from torch import Tensor

from benchmarks.rasterizers.hits import hits
from benchmarks.rasterizers.peers import NotMeasuredError, Round, differentiated, installed
from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians

NOTE = (
    "its _quat_scale_to_covar_preci, _fully_fused_projection, _spherical_harmonics and accumulate "
    "on the CPU; the list of (pixel, Gaussian) hits, which needs CUDA, is given free; nerfacc's "
    "scan, which needs CUDA, is a torch.cumsum"
)
MOST_HITS = 12_000_000  # its tensors of that many rows take some gigabytes


def render_weight_from_alpha(
    alphas: Tensor, *, ray_indices: Tensor, n_rays: int
) -> tuple[Tensor, Tensor]:
    """nerfacc's function of that name: rays are runs of equal indices."""
    logs = torch.log1p(-alphas.double())  # one sum over all rays: float32 would lose them
    passed = torch.cumsum(logs, 0) - logs
    counts = torch.bincount(ray_indices, minlength=n_rays)
    starts = torch.cumsum(counts, 0) - counts
    first = passed[starts.clamp_max(len(alphas) - 1)]
    trans = torch.exp(passed - first[ray_indices]).to(alphas)
    return trans * alphas, trans


def accumulate_along_rays(
    weights: Tensor, values: Tensor | None, *, ray_indices: Tensor, n_rays: int
) -> Tensor:
    """nerfacc's function of that name, as it is there."""
    source = weights[:, None] if values is None else weights[:, None] * values
    return source.new_zeros(n_rays, source.shape[-1]).index_add(0, ray_indices, source)


def _reference() -> Any:
    installed("gsplat")
    with contextlib.redirect_stdout(io.StringIO()):  # it prints that there is no CUDA
        return importlib.import_module("gsplat.cuda._torch_impl")


def prepare(gaussians: Gaussians, camera: Camera) -> Round:
    if gaussians.means.device.type != "cpu":
        raise NotMeasuredError("measured on the CPU")
    reference = _reference()
    gaussian_ids, pixel_ids = hits(gaussians, camera, most=MOST_HITS)
    image_ids = torch.zeros_like(pixel_ids)
    nerfacc = ModuleType("nerfacc")
    nerfacc.render_weight_from_alpha = render_weight_from_alpha  # type: ignore[attr-defined]
    nerfacc.accumulate_along_rays = accumulate_along_rays  # type: ignore[attr-defined]
    request = RenderRequest()

    def draw(gaussians: Gaussians, camera: Camera) -> tuple[Tensor, ...]:
        covars, _ = reference._quat_scale_to_covar_preci(
            gaussians.quats, gaussians.scales, compute_preci=False
        )
        _, means2d, depths, conics, _ = reference._fully_fused_projection(
            gaussians.means,
            covars,
            camera.world_to_camera[None],
            camera.K[None],
            camera.width,
            camera.height,
            eps2d=request.low_pass,
            near_plane=request.near,
        )
        directions = gaussians.means - camera.center
        colors = reference._spherical_harmonics(gaussians.sh_degree, directions, gaussians.sh)
        channels = torch.cat((torch.clamp_min(colors + 0.5, 0.0)[None], depths[..., None]), -1)
        with mock.patch.dict(sys.modules, nerfacc=nerfacc):
            image, alpha = reference.accumulate(
                means2d,
                conics,
                gaussians.opacities[None],
                channels,
                gaussian_ids,
                pixel_ids,
                image_ids,
                camera.width,
                camera.height,
            )
        return image[0, ..., :3], alpha[0, ..., 0], image[0, ..., 3]

    return differentiated(draw)(gaussians, camera)
