"""Adam by one kernel against torch's own, in float64."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from hoigs.core.fast.adam import EACH, AdamKernel

CUDA = pytest.param(
    "cuda",
    marks=[
        pytest.mark.gpu,
        pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA"),
    ],
)
SHAPES = [(3,), (), (EACH + 7,), (2, EACH), (0,), (1000, 3)]
RATES = [1e-2, 3e-4, 0.0, 1e-3, 1e-3, 0.5]


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_equals_torch(device: str) -> None:
    torch.manual_seed(0)
    start = [torch.randn(shape) for shape in SHAPES]
    exact = [torch.nn.Parameter(x.double()) for x in start]
    groups = [{"params": [p], "lr": rate} for p, rate in zip(exact, RATES, strict=True)]
    adam = torch.optim.Adam(groups, eps=1e-15)
    values = [x.to(device) for x in start]
    kept = [
        (torch.zeros_like(x), torch.zeros_like(x), torch.zeros((), device=device)) for x in values
    ]
    kernel = AdamKernel((0.9, 0.999), 1e-15)
    for step in range(6):
        finite = torch.tensor(step != 3, device=device)
        gradients = [torch.randn(shape) * 10.0 ** (-4 * (step % 3)) for shape in SHAPES]
        if step == 3:
            gradients[0][:] = torch.nan
        else:
            for parameter, gradient in zip(exact, gradients, strict=True):
                parameter.grad = gradient.double()
            adam.step()
        stepped = []
        for value, gradient, (mean, square, count) in zip(values, gradients, kept, strict=True):
            stepped.append((value, gradient.to(device), mean, square, count))
        kernel(stepped, RATES, finite)
    for value, parameter, before in zip(values, exact, start, strict=True):
        change, wanted = value.cpu().double() - before, parameter.detach() - before
        torch.testing.assert_close(change, wanted, rtol=1e-4, atol=2e-6)  # of values of 4
    moments: list[Tensor] = [adam.state[p]["exp_avg_sq"] for p in exact]
    for (_, square, count), wanted in zip(kept, moments, strict=True):
        torch.testing.assert_close(square.cpu().double(), wanted, rtol=1e-5, atol=0)
        assert count == 5
