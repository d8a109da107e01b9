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
    """What is launched in this block goes into `graph`; other threads may go on using CUDA.

    Args:
        stream: to capture on. pool: of another graph, for memory that both use.
    """
    settings: dict[str, Any] = {"stream": stream, "capture_error_mode": "thread_local"}
    with uncollected(), torch.cuda.graph(graph, pool=pool, **settings):
        yield


@contextmanager
def uncollected() -> Iterator[None]:
    """Nothing is garbage-collected in this block.

    An older graph that is part of a cycle would be destroyed at whatever line the collector runs,
    and destroying one breaks the capture of another (pytorch/pytorch#161037; PyTorch collected
    before each capture until 2.8).
    """
    was = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()
