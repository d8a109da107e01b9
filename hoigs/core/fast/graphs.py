"""CUDA graphs: how a computation is captured, and what a captured one may contain."""

from __future__ import annotations

import gc
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch


@contextmanager
def capturing(
    graph: torch.cuda.CUDAGraph, stream: torch.cuda.Stream, pool: Any = None
) -> Iterator[None]:
    """Capture the kernels that this block launches; other threads may go on using CUDA.

    Args:
        stream: to capture on. pool: memory pool of another graph, to share its memory.
    """
    settings: dict[str, Any] = {"stream": stream, "capture_error_mode": "thread_local"}
    with no_garbage_collection(), torch.cuda.graph(graph, pool=pool, **settings):
        yield


@contextmanager
def no_garbage_collection() -> Iterator[None]:
    """Switch the garbage collector off in this block.

    An older graph that is part of a reference cycle would be destroyed wherever the collector
    happens to run, and destroying a graph breaks the capture of another (pytorch/pytorch#161037;
    PyTorch collected before each capture until 2.8).
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


# Which components may be captured in a CUDA graph.
#
# A replay repeats the operations of one call on the same memory. A component may be captured, and
# declares so by `cuda_graph_safe = True` in its own class, if in training mode
#
# - it reads the time, a 0-d tensor (`hoigs.core.device.Time`), and the values of parameters,
#   buffers and poses on the device only: no `float(x)`, `x.item()`, `if x > 0` or boolean indexing,
#   and no tensor made from Python numbers (`hoigs.core.device.constant` keeps those);
# - its sequence of operations depends on nothing that changes from step to step, except shapes and
#   which tensors are parameters or buffers: not on `progress`, nor on a count of calls;
# - nothing is random, and no call keeps anything for the next one.
#
# A subclass does not inherit the declaration, since an override may break these rules.


def why_not_cuda_graph_safe(components: Mapping[str, object]) -> str | None:
    """Name the first component that may not be captured; None if all may.

    Args:
        components: by the name that the message uses; None stands for a component that is absent.
    """
    for name, component in components.items():
        declared = component is None or "cuda_graph_safe" in vars(type(component))
        if not declared or not getattr(component, "cuda_graph_safe", True):
            return f"{name}, a {type(component).__name__}, is not cuda_graph_safe"
    return None
