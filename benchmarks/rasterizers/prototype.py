"""The measured prototype, loaded by path where it lies beside the repository."""

from __future__ import annotations

import importlib.util
import os
import sys
import time
from functools import cache
from types import ModuleType

import torch
from torch import Tensor

from benchmarks.rasterizers.peers import NotMeasuredError, Round
from benchmarks.rasterizers.scenes import SHARED
from hoigs.core.camera import Camera
from hoigs.core.gaussians import Gaussians
from hoigs.core.harmonics import sh_to_colors
from hoigs.core.projection import project
from hoigs.core.rasterizer import RenderRequest

FOLDER = SHARED / "prototypes" / "warp-cpu"
NOTE = (
    "without projection, harmonics and autograd: means2d, conics, colours, opacities and depths "
    "given free, gradients to these; on torch's own pool; the faster of its two tile sizes"
)


@cache
def _load(tile: int) -> ModuleType:
    if not FOLDER.exists():
        raise NotMeasuredError(f"{FOLDER} is not there")
    os.environ["TS"], os.environ["WPT"] = str(tile), str(torch.get_num_threads())
    sys.path.insert(0, str(FOLDER))
    try:
        spec = importlib.util.spec_from_file_location(f"prototype_{tile}", FOLDER / "tiles.py")
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(FOLDER))
    return module


def prepare(gaussians: Gaussians, camera: Camera) -> Round:
    if gaussians.means.device.type != "cpu":
        raise NotMeasuredError("its fast kernels are for CPUs")
    width, height = camera.width, camera.height
    shown = project(gaussians, camera, RenderRequest())
    colors = sh_to_colors(gaussians.sh, gaussians.means, camera.center)[shown.index]
    inputs = [
        x.contiguous() for x in (shown.means2d, shown.conics, colors, shown.opacities, shown.depths)
    ]
    upstream = (torch.rand(height, width, 3), torch.rand(height, width), torch.rand(height, width))
    kept = []

    def forward_with(module: ModuleType) -> Tensor:
        raster = module.Raster()
        color = raster.fwd(*inputs, width, height)[0]
        kept[:] = [raster]
        return color

    def backward() -> None:
        kept.pop().bwd(*upstream)

    def seconds(module: ModuleType) -> float:
        best = float("inf")
        for _ in range(4):
            start = time.perf_counter()
            forward_with(module)
            backward()
            best = min(best, time.perf_counter() - start)
        return best

    fastest = min((_load(16), _load(32)), key=seconds)
    return Round(lambda: forward_with(fastest), backward)
