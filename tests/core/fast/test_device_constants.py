"""Times as 0-d tensors give the same as numbers: splines, knots, planes, frames between frames."""

from __future__ import annotations

import pytest
import torch

from hoigs.core.device import constant, filled
from hoigs.core.maths import splines
from hoigs.core.maths.feature_planes import PairedPlanes, ProductPlanes
from hoigs.core.maths.frame_times import TrainedFrames, at_frame
from hoigs.core.maths.splines import Knots, keyframe_position

TIMES = (-0.2, 0.0, 0.1, 1 / 7, 0.3, 0.5, 0.77, 6 / 7, 0.999, 1.0, 1.3)


def on_device(time: float) -> torch.Tensor:
    return torch.tensor(time, dtype=torch.float64)


@pytest.mark.parametrize("time", TIMES)
@pytest.mark.parametrize("count", [2, 3, 8])
@pytest.mark.parametrize("derivative", [False, True])
def test_splines(time: float, count: int, derivative: bool) -> None:
    generator = torch.Generator().manual_seed(count)
    values, slopes = torch.randn(2, 5, count, 3, generator=generator)
    for curve in (
        lambda at: splines.cubic_hermite(values, slopes, at, derivative=derivative),
        lambda at: splines.catmull_rom(values, at, derivative=derivative),
        lambda at: splines.linear(values, at),
    ):
        found = [curve(keyframe_position(t, count)) for t in (on_device(time), time)]
        torch.testing.assert_close(*found, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("time", TIMES)
@pytest.mark.parametrize("movable", [False, True])
def test_knots(time: float, movable: bool) -> None:
    knots = Knots(5, movable=movable)
    if movable:
        knots.place((0.0, 0.1, 0.45, 0.5, 1.0))
    generator = torch.Generator().manual_seed(3)
    values, slopes = torch.randn(2, 6, 5, 4, generator=generator)
    for curve in (
        lambda t: knots.hermite(values, slopes, t),
        lambda t: knots.hermite(values, slopes, t, derivative=True),
        lambda t: knots.catmull_rom(values, t),
        lambda t: knots.linear(values, t),
        lambda t: knots.slerp(values, t),
    ):
        torch.testing.assert_close(curve(on_device(time)), curve(time), atol=2e-6, rtol=1e-5)


@pytest.mark.parametrize("trained", [None, (0, 1, 3, 7), (2, 5)])
def test_frames_between_trained_ones(trained: tuple[int, ...] | None) -> None:
    frames = TrainedFrames(8, trained)
    values = torch.randn(8, 2, 3, generator=torch.Generator().manual_seed(0))
    for time in (*TIMES, *(f / 7 for f in range(8)), 3 / 7 + 1e-6, 3 / 7 - 1e-6):
        torch.testing.assert_close(
            frames.between(values, on_device(time)), frames.between(values, time)
        )
        assert torch.equal(at_frame(values, on_device(time)), at_frame(values, time))


@pytest.mark.parametrize("time", TIMES)
def test_planes(time: float) -> None:
    torch.manual_seed(0)
    points = 2.4 * torch.rand(30, 3) - 1.2
    paired, product = PairedPlanes(4, 6, 3), ProductPlanes(4, (6, 12), 3)
    for planes in (paired, product):
        for parameter in planes.parameters():
            torch.nn.init.normal_(parameter)
        torch.testing.assert_close(planes(points, on_device(time)), planes(points, time))


def test_a_constant_is_made_once() -> None:
    like = torch.zeros(3)
    assert constant((1, 2), like) is constant((1, 2), like)
    assert constant((1, 2), like.double()).dtype == torch.float64
    assert constant((1, 2), like, torch.long).tolist() == [1, 2]
    assert torch.equal(filled(like, (2, 2), on_device(0.5)), torch.full((2, 2), 0.5))
