"""The backends that the conformance tests run on."""

from __future__ import annotations

import pytest
import torch
from raster_scenes import Backend

from hoigs.core.rasterizer import Rasterizer


def make(name: str) -> Rasterizer:
    if name == "torch":
        from hoigs.rasterizers.torch_tiles import TorchRasterizer

        return TorchRasterizer()
    from hoigs.rasterizers.warp import WarpRasterizer

    return WarpRasterizer(cpu_kernels="portable" if name == "warp-portable" else "native")


DEVICES = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]


@pytest.fixture(
    scope="session",
    params=[
        pytest.param(
            (name, device), id=f"{name}-{device}", marks=[pytest.mark.gpu] * (device != "cpu")
        )
        for name in ("torch", "warp", "warp-portable")  # portable: CUDA's kernels, on the CPU
        for device in (DEVICES if name != "warp-portable" else ["cpu"])
    ],
)
def backend(request: pytest.FixtureRequest) -> Backend:
    """Every backend on every device of this machine."""
    name, device = request.param
    return Backend(make(name), torch.device(device))
