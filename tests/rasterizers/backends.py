"""The backends that the conformance checks run on, each on every device that it declares."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
import torch

from hoigs.core.interfaces.rasterizer import Rasterizer
from hoigs.rasterizers.gsplat import GsplatRasterizer
from hoigs.rasterizers.oracle import OracleRasterizer
from hoigs.rasterizers.torch_tiles import TorchRasterizer
from hoigs.rasterizers.warp import WarpConfig, WarpRasterizer
from hoigs.testing.checks import Check
from hoigs.testing.rasterizer import CHECKS, RasterizerSubject

BACKENDS: dict[str, Callable[[], Rasterizer]] = {
    "torch": TorchRasterizer,
    "oracle": lambda: OracleRasterizer(OracleRasterizer.Config(cutoffs=True)),
    "warp": lambda: WarpRasterizer(WarpConfig(threads=2)),
    # CUDA's kernels, on the CPU
    "warp-portable": lambda: WarpRasterizer(
        WarpRasterizer.Config(cpu_kernels="portable", threads=2)
    ),
    "gsplat": GsplatRasterizer,
}


def cases(
    able: Callable[[Rasterizer], bool] = lambda rasterizer: True,
) -> Iterator[pytest.ParameterSet]:
    """Parameters of the fixture `backend`; only those for which `able` is true."""
    for name, make in BACKENDS.items():
        devices = {"cpu"} if name == "warp-portable" else make().capabilities.devices
        for device in sorted(devices) if able(make()) else ():
            marks = [pytest.mark.gpu] if device == "cuda" else []
            yield pytest.param((name, device), id=f"{name}-{device}", marks=marks)


def cases_with_checks() -> Iterator[pytest.ParameterSet]:
    """Each backend with each check that needs no more than it declares."""
    for case in cases():
        ((name, device),) = case.values
        subject = RasterizerSubject(BACKENDS[name](), torch.device(device))
        for check in declared(subject):
            yield pytest.param(*case.values, check, id=f"{case.id}-{check.id}", marks=case.marks)


def declared(subject: RasterizerSubject) -> list[Check[RasterizerSubject]]:
    return [check for check in CHECKS if check.missing(subject) is None]
