"""The backends that the conformance checks run on, each on every device that it declares."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator

import pytest
import torch

from hoigs.core.rasterizer import Rasterizer
from hoigs.rasterizers.gsplat import GsplatRasterizer
from hoigs.rasterizers.oracle import OracleRasterizer
from hoigs.rasterizers.torch_tiles import TorchRasterizer
from hoigs.rasterizers.warp import WarpRasterizer
from hoigs.testing.rasterizer import RasterizerSubject

BACKENDS: dict[str, Callable[[], Rasterizer]] = {
    "torch": TorchRasterizer,
    "oracle": lambda: OracleRasterizer(cutoffs=True),
    "warp": lambda: WarpRasterizer(threads=2),
    # CUDA's kernels, on the CPU
    "warp-portable": lambda: WarpRasterizer(cpu_kernels="portable", threads=2),
    "gsplat": GsplatRasterizer,
}


def cases() -> Iterator[pytest.ParameterSet]:
    for name, make in BACKENDS.items():
        devices = {"cpu"} if name == "warp-portable" else make().capabilities.devices
        for device in sorted(devices):
            marks = [pytest.mark.gpu] if device == "cuda" else []
            yield pytest.param((name, device), id=f"{name}-{device}", marks=marks)


@pytest.fixture(scope="session", params=list(cases()))
def backend(request: pytest.FixtureRequest) -> RasterizerSubject:
    """Every backend on every device."""
    name, device = request.param
    if device == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    if name == "gsplat" and importlib.util.find_spec("gsplat") is None:
        pytest.skip("gsplat is not installed: pip install 'hoigs[gsplat]'")
    return RasterizerSubject(BACKENDS[name](), torch.device(device))


@pytest.fixture(scope="module")
def one_torch_thread() -> Iterator[None]:
    """These pictures are so small that torch's second thread only waits."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
