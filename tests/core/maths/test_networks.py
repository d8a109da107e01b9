"""Chains of layers: the CPU kernels against the layers themselves in float64."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import Tensor, nn

from hoigs.core.fast.dense import WORTHWHILE, wide_vectors
from hoigs.core.maths.networks import dense

WIDE = pytest.mark.skipif(not wide_vectors(), reason="no AVX-512")


def chain(bias: bool = True) -> nn.Sequential:
    torch.manual_seed(0)
    return nn.Sequential(
        nn.Linear(11, 24, bias=bias), nn.ReLU(inplace=True), nn.Linear(24, 20), nn.ReLU(),
        nn.Linear(20, 7),
    )  # fmt: skip


def upstream(values: Tensor) -> Tensor:
    torch.manual_seed(1)
    return torch.randn(values.shape).to(values)


def everything(layers: nn.Sequential, rows: Tensor) -> list[Tensor]:
    """Values, and gradients of the rows and of all parameters."""
    rows = rows.clone().requires_grad_()
    values = dense(layers, rows)
    sources = [rows, *layers.parameters()]
    return [values.detach(), *torch.autograd.grad(values, sources, upstream(values))]


@WIDE
@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize("count", [WORTHWHILE, 1999])
def test_layers_and_their_gradients(bias: bool, count: int) -> None:
    layers, rows = chain(bias), torch.randn(count, 11)
    assert "DenseLayer" in str(dense(layers, rows.clone().requires_grad_()).grad_fn)
    double = copy.deepcopy(layers).double()
    exact = everything(double, rows.double())
    for ours, theirs in zip(everything(layers, rows), exact, strict=True):
        bound = 1e-5 * float(theirs.abs().amax())
        torch.testing.assert_close(ours.double(), theirs, rtol=0, atol=bound)


@WIDE
def test_the_same_bits_on_any_number_of_cores() -> None:
    layers, rows = chain(), torch.randn(1999, 11)
    before = torch.get_num_threads()
    try:
        results = []
        for threads in (1, 4):
            torch.set_num_threads(threads)
            results.append(everything(layers, rows))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


@WIDE
def test_what_is_frozen_gets_no_gradient() -> None:
    layers, rows = chain(), torch.randn(300, 11)
    wanted = everything(layers, rows)
    frozen = copy.deepcopy(layers).requires_grad_(False)
    assert not dense(frozen, rows).requires_grad
    sources = rows.clone().requires_grad_()
    values = dense(frozen, sources)
    values.backward(upstream(values))
    torch.testing.assert_close(sources.grad, wanted[1], rtol=0, atol=0)
    values = dense(layers, rows)  # of rows that need none
    values.backward(upstream(values))
    for parameter, gradient in zip(layers.parameters(), wanted[2:], strict=True):
        torch.testing.assert_close(parameter.grad, gradient, rtol=0, atol=0)


def test_few_rows_and_wide_layers_go_through_the_layers() -> None:
    few = dense(chain(), torch.randn(WORTHWHILE - 1, 11).requires_grad_())
    wide = nn.Sequential(nn.Linear(300, 4))
    many = dense(wide, torch.randn(WORTHWHILE, 300).requires_grad_())
    assert "DenseLayer" not in str(few.grad_fn) + str(many.grad_fn)


@WIDE
def test_other_layers_are_refused() -> None:
    layers = nn.Sequential(nn.Linear(3, 4), nn.GELU())
    with pytest.raises(TypeError, match="GELU"):
        dense(layers, torch.zeros(WORTHWHILE, 3))
