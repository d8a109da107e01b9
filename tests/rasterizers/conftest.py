"""Fixtures of the rasterizers' tests: a backend on a device."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator

import pytest
import torch
from backends import BACKENDS, cases

from hoigs.testing.rasterizer import RasterizerSubject


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
