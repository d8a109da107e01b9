"""Chains of layers: oneDNN's products against the layers themselves in float64."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import Tensor, nn

from hoigs.core.maths import networks
from hoigs.core.maths.networks import dense


def chain(bias: bool = True) -> nn.Sequential:
    torch.manual_seed(0)
    return nn.Sequential(
        nn.Linear(11, 24, bias=bias), nn.ReLU(inplace=True), nn.Linear(24, 20), nn.ReLU(),
        nn.Linear(20, 7),
    )  # fmt: skip


def everything(layers: nn.Sequential, rows: Tensor) -> list[Tensor]:
    """Values, and gradients of the rows and of all parameters."""
    rows = rows.clone().requires_grad_()
    values = dense(layers, rows)
    upstream = torch.linspace(-1, 1, values.numel()).view_as(values).to(values)
    sources = [rows, *layers.parameters()]
    return [values.detach(), *torch.autograd.grad(values, sources, upstream)]


@pytest.mark.parametrize("bias", [True, False])
def test_layers_and_their_gradients(bias: bool) -> None:
    if not networks._onednn_has_wider_vectors():
        pytest.skip("oneDNN has no wider vectors here")
    layers, rows = chain(bias), torch.randn(networks.WORTHWHILE + 1, 11)
    assert networks._by_onednn(rows) and not networks._by_onednn(rows.double())
    double = copy.deepcopy(layers).double()
    exact = everything(double, rows.double())
    for ours, theirs in zip(everything(layers, rows), exact, strict=True):
        bound = 1e-5 * float(theirs.abs().amax())
        torch.testing.assert_close(ours.double(), theirs, rtol=0, atol=bound)


def test_what_needs_no_gradient_gets_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """Frozen layers cost nothing, and a few rows go through the layers themselves."""
    if not networks._onednn_has_wider_vectors():
        pytest.skip("oneDNN has no wider vectors here")
    layers, rows = chain().requires_grad_(False), torch.randn(networks.WORTHWHILE, 11)
    assert not dense(layers, rows).requires_grad
    seen: list[str] = []
    product = networks._product
    monkeypatch.setattr(
        networks, "_product", lambda *a: (seen.append(str(tuple(a[0].shape))), product(*a))[1]
    )
    dense(layers, rows.requires_grad_()).sum().backward()
    assert len(seen) == 6, "three products forward, three for the rows, none for the weights"
    seen.clear()
    dense(layers, rows[: networks.WORTHWHILE - 1])
    assert not seen


def test_other_layers_are_refused() -> None:
    if not networks._onednn_has_wider_vectors():
        pytest.skip("oneDNN has no wider vectors here")
    layers = nn.Sequential(nn.Linear(3, 4), nn.GELU())
    with pytest.raises(TypeError, match="expected Linear and ReLU, got GELU"):
        dense(layers, torch.zeros(networks.WORTHWHILE, 3))
