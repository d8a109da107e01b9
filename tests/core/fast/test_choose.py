"""Where the CPU kernels are used, and that torch does the same where they do not compile."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from hoigs.core.device import replacement
from hoigs.core.fast import choose
from hoigs.core.maths.feature_planes import sample_planes


def test_only_float32_on_cpus() -> None:
    values = torch.zeros(2)
    assert replacement(sample_planes, values) is not None
    assert replacement(sample_planes, values, torch.zeros(2, dtype=torch.int64)) is not None
    assert replacement(sample_planes, values, values.double()) is None
    assert replacement(sample_planes, values, values.to("meta")) is None


def test_what_is_replaced_is_there_and_replaceable() -> None:
    for name in (*choose.KERNELS, *choose.CUDA_KERNELS, *choose.BATCHED):
        module, _, function = name.rpartition(".")
        assert hasattr(getattr(importlib.import_module(module), function), "__wrapped__"), name
    for name, kernels in (*choose.KERNELS.items(), *choose.CUDA_KERNELS.items()):
        module = importlib.import_module(f"hoigs.core.fast.{kernels}")
        assert callable(getattr(module, name.rpartition(".")[2]))


def test_where_kernels_do_not_compile_torch_does_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    from hoigs.core.system.quiet_warp import wp

    planes, points = torch.randn(2, 5, 4, 3), torch.rand(2, 20, 2) * 2 - 1
    wanted = sample_planes(planes, points)

    def fail(*arguments: object, **more: object) -> None:
        raise Exception("CPU kernel build failed with error code -1")

    choose._compiled.cache_clear()
    with monkeypatch.context() as broken:
        broken.setattr(wp, "load_module", fail)
        with pytest.warns(UserWarning, match=r"planes.*failed"):
            found = sample_planes(planes, points)
    choose._compiled.cache_clear()
    torch.testing.assert_close(found, wanted)
    assert "SampledPlanes" in str(sample_planes(planes.requires_grad_(), points).grad_fn)


def test_importing_the_mathematics_does_not_start_warp() -> None:
    code = """
import sys
import hoigs.core.maths.feature_planes, hoigs.core.maths.skinning
assert "warp" not in sys.modules and "hoigs.core.fast" not in sys.modules
"""
    root = Path(__file__).parents[3]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, check=False)
    assert done.returncode == 0
