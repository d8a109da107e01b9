"""No garbage is collected while a CUDA graph is captured."""

from __future__ import annotations

import gc
from collections.abc import Iterator

import pytest
import torch

from hoigs.core.fast.graphs import capturing, no_garbage_collection


class Circle:
    """A reference cycle, which only the garbage collector frees."""

    gone = 0

    def __init__(self, held: object = None) -> None:
        self.held, self.itself = held, self

    def __del__(self) -> None:
        Circle.gone += 1


@pytest.fixture
def eager() -> Iterator[None]:
    """A garbage collector that runs as often as possible."""
    before = gc.get_threshold()
    gc.collect()
    Circle.gone = 0
    gc.set_threshold(1)
    yield
    gc.set_threshold(*before)
    gc.enable()


def litter() -> None:
    for _ in range(100):
        Circle()


@pytest.mark.parametrize("on", [True, False])
def test_nothing_is_collected_within_and_the_collector_is_left_as_it_was(eager, on):
    if not on:
        gc.disable()
    with pytest.raises(KeyError), no_garbage_collection():
        litter()
        assert Circle.gone == 0
        raise KeyError("in between")
    assert gc.isenabled() is on
    gc.collect()
    assert Circle.gone == 100


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_an_older_graph_may_be_garbage(eager):
    stream, out = torch.cuda.Stream(), torch.zeros(3, device="cuda")
    for _ in range(20):
        graph = torch.cuda.CUDAGraph()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream), capturing(graph, stream):
            litter()
            out += 1
        torch.cuda.current_stream().wait_stream(stream)
        graph.replay()
        Circle(graph)
        del graph
    assert out.tolist() == [20.0] * 3
