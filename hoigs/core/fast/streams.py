"""Independent parts of a CUDA graph side by side, each on a stream of its own.

Most kernels of a deformation are small and leave a GPU idle, so a graph in which people, objects
and renders follow each other takes as long as all of them together. Where they are captured on
streams of their own, the graph has branches, and a replay runs them at the same time.

Memory of a stream is used again as soon as Python frees it, which is safe on that stream alone. So
what crosses from one stream to another is marked (`Tensor.record_stream`); autograd marks gradients
itself. What a component keeps between calls must stay on its stream: all works of one entity have
the same name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import torch
from torch import Tensor

T = TypeVar("T")
_now: ContextVar[dict[str, torch.cuda.Stream] | None] = ContextVar("_now", default=None)


@contextmanager
def side_by_side(streams: dict[str, torch.cuda.Stream]) -> Iterator[None]:
    """In this block `apart` uses streams, also before a capture, so that both do the same.

    Args:
        streams: by name of the work; `apart` adds those that it misses.
    """
    token = _now.set(streams)
    # parameters are read on several streams: autograd waits for these, and newer versions warn
    warn = getattr(torch.autograd.graph, "set_warn_on_accumulate_grad_stream_mismatch", None)
    if warn is not None:
        warn(False)
    try:
        yield
    finally:
        _now.reset(token)
        if warn is not None:
            warn(True)


def apart(works: Mapping[str, Callable[[], T]], inputs: Any = None) -> dict[str, T]:
    """The results of works that do not need each other, in `side_by_side` each on a stream.

    Args:
        works: by name of the stream. inputs: values, in dataclasses, mappings and sequences, with
            the tensors that works read and that are no parameters or buffers.
    """
    streams = _now.get()
    if streams is None or len(works) < 2:
        return {name: work() for name, work in works.items()}
    current = torch.cuda.current_stream()
    found = {}
    for name, work in works.items():
        stream = streams.get(name)
        if stream is None:
            stream = streams[name] = torch.cuda.Stream(current.device)
        _mark(inputs, stream)
        stream.wait_stream(current)
        with torch.cuda.stream(stream):
            found[name] = work()
    for name, result in found.items():
        current.wait_stream(streams[name])
        _mark(result, current)
    return found


def _mark(values: Any, stream: torch.cuda.Stream) -> None:
    """Tell the allocator that a stream uses the tensors in some values."""
    if isinstance(values, Tensor):
        if values.is_cuda:
            values.record_stream(stream)
    elif is_dataclass(values) and not isinstance(values, type):
        for f in fields(values):
            _mark(getattr(values, f.name), stream)
    elif isinstance(values, Mapping):
        for value in values.values():
            _mark(value, stream)
    elif isinstance(values, Sequence) and not isinstance(values, str):
        for value in values:
            _mark(value, stream)
