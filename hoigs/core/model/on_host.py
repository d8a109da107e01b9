"""Work with a module's tensors on the CPU for a while."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol

import torch
from torch import Tensor, nn


class HasModules(Protocol):
    """The part of nn.Module that `on_host` needs."""

    def modules(self) -> Iterable[nn.Module]: ...


@contextmanager
def on_host(module: HasModules) -> Iterator[None]:
    """The module's tensors on the CPU, then back where they were.

    For hundreds of operations on a few numbers each, whose launches take a GPU seconds. A tensor
    that has the same values afterwards gets its old memory back, because CUDA graphs hold that
    memory; the others are copied to the device they were on. Gradients stay where they are.
    """
    places = [
        (own, name, tensor.data, tensor.data.cpu())
        for own in _owners(module)
        for name, tensor in own.items()
        if tensor is not None
    ]
    for own, name, _, host in places:
        _put(own, name, host)
    try:
        yield
    finally:
        for own, name, home, host in places:
            now = own[name].data
            same = now.shape == host.shape and torch.equal(now, host)
            _put(own, name, home if same else now.to(home.device))


def _owners(module: HasModules) -> Iterator[dict[str, Any]]:
    """Parameters and buffers of each submodule, by name; None where one has no value."""
    for part in module.modules():
        yield part._parameters
        yield part._buffers


def _put(own: dict[str, Any], name: str, value: Tensor) -> None:
    if isinstance(own[name], nn.Parameter):
        own[name].data = value
    else:
        own[name] = value
