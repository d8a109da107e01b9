"""Work with a module on the CPU for a while."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol

import torch
from torch import Tensor, nn


class Parted(Protocol):
    """A module, as far as it is needed here."""

    def modules(self) -> Iterable[nn.Module]: ...


@contextmanager
def on_host(module: Parted) -> Iterator[None]:
    """The module's tensors on the CPU, then back where they were.

    For hundreds of operations on a few numbers each, whose launches take a GPU seconds. What has
    the same values afterwards is the very same memory again, for CUDA graphs hold it; the rest
    comes to the device it was on. Gradients stay where they are.
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


def _owners(module: Parted) -> Iterator[dict[str, Any]]:
    """Parameters and buffers of each part, by name; None where one has no value."""
    for part in module.modules():
        yield part._parameters
        yield part._buffers


def _put(own: dict[str, Any], name: str, value: Tensor) -> None:
    if isinstance(own[name], nn.Parameter):
        own[name].data = value
    else:
        own[name] = value
