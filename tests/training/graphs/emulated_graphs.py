"""Emulated CUDA graphs on a CPU: a replay repeats the captured operations on the same memory.

A capture stores every operation with its arguments and results; a replay repeats them and writes
into those results. Numbers that Python passed stay as they were, as on a GPU. What would wait for
a device, or copy numbers from the host, ends the capture with an error, and so does a tensor
that is made without a device, which would be on the CPU.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

# waits for a GPU, or brings it numbers from the host: no graph can hold it
WAITING = frozenset(
    (
        "_local_scalar_dense", "nonzero", "masked_select", "is_nonzero", "equal", "bincount",
        "lift_fresh", "lift_fresh_copy", "_unique2", "unique_dim", "repeat_interleave",
    )
)  # fmt: skip

# makes a tensor on the CPU unless it gets a device; a graph on a GPU cannot bring it there
MAKING = frozenset(
    (
        torch.arange, torch.as_tensor, torch.empty, torch.eye, torch.full, torch.linspace,
        torch.ones, torch.tensor, torch.zeros,
    )
)  # fmt: skip


def waits(func: Any, args: Any) -> bool:
    """Whether a graph cannot hold this operation."""
    name = str(func).split(".")[1]
    if name in ("index", "index_put", "_index_put_impl_"):
        return any(x is not None and x.dtype == torch.bool for x in args[1])
    return name in WAITING


class EmulatedGraph:
    """Replaces torch.cuda.CUDAGraph."""

    def __init__(self) -> None:
        self.steps: list[tuple[Any, Any, Any, list[Any]]] = []

    def pool(self) -> None:
        return None

    def replay(self) -> None:
        with torch.no_grad():
            for func, args, kwargs, results in self.steps:
                again = tree_leaves(func(*args, **kwargs))
                if func._schema.is_mutable:
                    continue
                for result, value in zip(results, again, strict=True):
                    if isinstance(result, Tensor):
                        result.copy_(value)


class _Capture(TorchDispatchMode):
    def __init__(self, graph: EmulatedGraph) -> None:
        super().__init__()
        self.graph = graph

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if waits(func, args):
            raise RuntimeError(f"{func}: operation not permitted when stream is capturing")
        kwargs = kwargs or {}
        # as they are now: shapes may be changed in place
        kept = tree_map(lambda x: x.detach() if isinstance(x, Tensor) else x, (args, kwargs))
        result = func(*args, **kwargs)
        # views go on showing the memory of their base
        if not func.is_view and torch.Tag.inplace_view not in func.tags:
            results = [x.detach() if isinstance(x, Tensor) else x for x in tree_leaves(result)]
            self.graph.steps.append((func, *kept, results))
        return result


class _Making(TorchFunctionMode):
    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func in MAKING and "device" not in (kwargs or {}):
            raise RuntimeError(f"torch.{func.__name__} without a device, in a captured step")
        return func(*args, **(kwargs or {}))


class _Stream:
    def __init__(self, device: Any = None) -> None:
        self.device = device

    def wait_stream(self, other: Any) -> None:
        del other


@contextmanager
def _capturing(graph: EmulatedGraph, **settings: Any) -> Iterator[None]:
    del settings
    with _Capture(graph), _Making():
        yield


def emulate(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the CUDA graphs of torch.cuda by emulated ones."""
    # an emulated graph replays torch operations; kernels of the CPU alone are none, nor on CUDA
    monkeypatch.setattr("hoigs.core.fast.choose._compiled", lambda name: None)
    monkeypatch.setattr(torch.cuda, "CUDAGraph", EmulatedGraph)
    monkeypatch.setattr(torch.cuda, "graph", _capturing)
    monkeypatch.setattr(torch.cuda, "Stream", _Stream)
    monkeypatch.setattr(torch.cuda, "stream", lambda stream: nullcontext())
    monkeypatch.setattr(torch.cuda, "device", lambda device: nullcontext())
    monkeypatch.setattr(torch.cuda, "current_stream", _Stream)
    monkeypatch.setattr(torch.cuda, "synchronize", lambda device: None)
