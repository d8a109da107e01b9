"""Parameters: how they start, and where their number or place changes in training."""

from __future__ import annotations

import ctypes
import math
import mmap
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import torch
from torch import Tensor, nn

from hoigs.core.system.threads import c_library


def zeroed(layer: nn.Linear) -> nn.Linear:
    """`layer` with weights and bias of zero, for a network that starts by changing nothing."""
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer


class Resizing(nn.Module):
    """A module whose parameters take the stored size before a checkpoint is loaded.

    Attributes:
        resizes: name of a parameter or buffer of this module to the axis along which it may grow
            or shrink; any other difference of shape stays an error.
    """

    resizes: ClassVar[Mapping[str, int]] = {}

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: Any) -> None:
        for name, axis in self.resizes.items():
            stored, own = state_dict.get(prefix + name), getattr(self, name, None)
            if stored is None or own is None or stored.dim() != own.dim():
                continue
            shape = list(own.shape)
            shape[axis] = stored.shape[axis]
            if isinstance(own, nn.Parameter):
                own.grad = None
                own.data = own.data.new_zeros(shape)
            else:
                setattr(self, name, own.new_zeros(shape))
        super()._load_from_state_dict(state_dict, prefix, *rest)


# Parameters whose rows belong to times of the clip, of which only some may be there.

MARGIN = 2  # rows beside those about a time that an interpolation may read


@dataclass
class TimeRows:
    """Rows along axis 1 of a parameter, at times evenly spread over [0, 1].

    A module has `time_rows`, a TimeRows by the name of each such parameter of its own. Training in
    windows then keeps the rows of one window alone, and sets `first`; whoever reads the parameter
    counts its rows from there.

    Attributes:
        count: T, of all rows; row i belongs to time i / (T - 1).
        first: number of the first row that is there.
    """

    count: int
    first: int = 0

    def about(self, start: float, end: float) -> slice:
        """The rows that are read between two times."""
        last = self.count - 1
        first = max(0, math.floor(start * last) - MARGIN)
        return slice(first, min(self.count, math.ceil(end * last) + MARGIN + 1))

    def local(self, time: Any, present: int) -> Any:
        """A time in [0, 1] as the part of the way from the first to the last row that is there.

        Args:
            present: number of these rows.
        """
        if present == self.count:
            return time
        return (time * (self.count - 1) - self.first) / max(1, present - 1)


class OverTime(nn.Module):
    """A module that reads rows for times: of its own parameters, or of values that it is given.

    Attributes:
        rows: which of them are there.
        time_rows: `rows` by the name of each own parameter that has them along axis 1.
    """

    rows: TimeRows
    time_rows: Mapping[str, TimeRows]

    def keep_rows(self, count: int, *names: str) -> None:
        """`count` rows for times, of the parameters `names`."""
        self.rows = TimeRows(count)
        self.time_rows = dict.fromkeys(names, self.rows)


def timed_parameters(model: nn.Module) -> Iterator[tuple[str, TimeRows]]:
    """The dotted name of every parameter that has rows for times."""
    for path, module in model.named_modules():
        for name, rows in getattr(module, "time_rows", {}).items():
            yield f"{path}.{name}", rows


# Work with a module's tensors on the CPU for a while.


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


# release_pages: memory of tensors whose numbers also lie in a file goes back to the system.

PAGEOUT = 21  # Linux's MADV_PAGEOUT: pages are read anew when they are used, nothing is lost
PIECE = 256  # frames after which what was read for them is given back


def release_time_rows(model: nn.Module) -> None:
    """Give back the memory of rows for times that `restore_model` left in a file."""
    release_pages(model.get_parameter(name) for name, _ in timed_parameters(model))


def release_pages(tensors: Iterable[Tensor]) -> None:
    """Let the system take back what was read of tensors that are mapped from a file.

    Their values stay as they are. Tensors that are not mapped from a file keep their memory where
    the machine has no swap. Systems without this advice (Linux has it since 5.4) do nothing.
    """
    if sys.platform != "linux":
        return
    for tensor in tensors:
        if tensor.device.type != "cpu" or not tensor.is_contiguous() or not tensor.nbytes:
            continue
        first = tensor.data_ptr() // mmap.PAGESIZE * mmap.PAGESIZE
        size = tensor.data_ptr() + tensor.nbytes - first
        c_library().madvise(ctypes.c_void_p(first), ctypes.c_size_t(size), PAGEOUT)
