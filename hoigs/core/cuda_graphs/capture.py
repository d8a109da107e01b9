"""Capturing CUDA graphs."""

from __future__ import annotations

import gc
from collections.abc import Iterator
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
