"""Cubic Hermite splines: the paper's basis by hand, indices at the ends, tangents, gradients."""

from __future__ import annotations

import math

import pytest
import torch

from hoigs.core.maths import splines
from hoigs.core.maths.rotations import quats_to_matrices, slerp
from hoigs.core.maths.splines import Knots, uniform_times


def test_basis_by_hand():
    weights = splines.hermite_weights
    assert weights(0.0) == (1, 0, 0, 0)
    assert weights(1.0) == (0, 0, 1, 0)
    assert weights(0.5) == pytest.approx((0.5, 0.125, 0.5, -0.125))
    assert weights(0.0, derivative=True) == (0, 1, 0, 0)
    assert weights(1.0, derivative=True) == (0, 0, 0, 1)


def at(time: float, values: torch.Tensor) -> splines.Interval:
    return splines.keyframe_position(time, values.shape[1])


def test_spline_by_hand():
    # r = 0.25 in the second of two intervals; h = (0.84375, 0.140625, 0.15625, -0.046875)
    values = torch.tensor([[[9.0], [2.0], [4.0]]])
    tangents = torch.tensor([[[7.0], [1.0], [-2.0]]])
    point = splines.cubic_hermite(values, tangents, at((1 + 0.25) / 2, values))
    expected = 0.84375 * 2 + 0.140625 * 1 + 0.15625 * 4 - 0.046875 * -2
    assert point.item() == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("num_frames", [2, 3, 5, 300])
@pytest.mark.parametrize("step", [1, 4, 7])
def test_last_frame_is_the_last_knot(num_frames: int, step: int):  # F7
    count = splines.keyframe_count(num_frames, step)
    generator = torch.Generator().manual_seed(num_frames * 10 + step)
    values = torch.randn(4, count, 3, generator=generator)
    tangents = torch.randn(4, count, 3, generator=generator)
    for frame, knot in ((0, 0), (num_frames - 1, count - 1)):
        time = frame / (num_frames - 1)
        place = at(time, values)
        for found in (
            splines.cubic_hermite(values, tangents, place),
            splines.catmull_rom(values, place),
            splines.linear(values, place),
        ):
            torch.testing.assert_close(found, values[:, knot])


@pytest.mark.parametrize(
    ("frames", "step", "count"), [(2, 4, 2), (64, 4, 17), (300, 4, 76), (5, 1, 5), (1, 4, 2)]
)
def test_keyframe_count(frames: int, step: int, count: int):
    assert splines.keyframe_count(frames, step) == count


@pytest.mark.parametrize("bad", [(0, 4), (10, 0)])
def test_keyframe_count_refuses(bad: tuple[int, int]):
    with pytest.raises(ValueError, match="at least one frame"):
        splines.keyframe_count(*bad)


def test_times_outside_are_held():  # F9
    values = torch.randn(3, 4, 3)
    torch.testing.assert_close(splines.catmull_rom(values, at(1.2, values)), values[:, -1])
    torch.testing.assert_close(splines.catmull_rom(values, at(-0.3, values)), values[:, 0])
    with pytest.raises(ValueError, match="at least 2 keyframes"):
        splines.keyframe_position(0.5, 1)


def test_first_interval_beyond_training_is_close():  # F8: a test frame before the first train one
    times = torch.linspace(0, 1, 12)
    values = torch.stack((times, times.square(), torch.sin(3 * times)), -1)[None]
    step = (values[:, 1:] - values[:, :-1]).norm(dim=-1).max()
    ends = splines.catmull_rom(values, at(-1 / 40, values)) - values[:, 0]
    assert ends.norm() < 2 * step


def test_tangents_by_hand():
    values = torch.tensor([[[0.0], [1.0], [4.0], [9.0]]])
    assert splines.finite_differences(values).flatten().tolist() == [1, 2, 4, 5]
    assert splines.finite_differences(values[:, :2]).flatten().tolist() == [1, 1]
    assert splines.accelerations(values).flatten().tolist() == [2, 2]


@pytest.mark.parametrize("count", [2, 3, 4, 7])
@pytest.mark.parametrize("derivative", [False, True])
def test_window_equals_whole(count: int, derivative: bool):
    """catmull_rom reads four knots; with all tangents the value must be the same."""
    values = torch.randn(5, count, 2, dtype=torch.float64)
    tangents = splines.finite_differences(values)
    for time in torch.linspace(0, 1, 23).tolist():
        torch.testing.assert_close(
            splines.catmull_rom(values, at(time, values), derivative=derivative),
            splines.cubic_hermite(values, tangents, at(time, values), derivative=derivative),
        )


def test_derivative_is_per_interval():
    values = torch.randn(3, 5, 3, dtype=torch.float64)
    tangents = torch.randn(3, 5, 3, dtype=torch.float64)
    h = 1e-6
    for time in (0.11, 0.37, 0.9):
        ahead = splines.cubic_hermite(values, tangents, at(time + h, values))
        behind = splines.cubic_hermite(values, tangents, at(time - h, values))
        numeric = (ahead - behind) / (2 * h * 4)  # 4 intervals in unit time
        exact = splines.cubic_hermite(values, tangents, at(time, values), derivative=True)
        torch.testing.assert_close(exact, numeric, atol=1e-7, rtol=1e-6)


def test_gradcheck():
    values = torch.randn(2, 4, 3, dtype=torch.float64, requires_grad=True)
    tangents = torch.randn(2, 4, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda m, t: splines.cubic_hermite(m, t, at(0.61, m)), (values, tangents)
    )
    assert torch.autograd.gradcheck(lambda m: splines.catmull_rom(m, at(0.61, m)), (values,))


def test_only_neighbouring_knots_get_gradient():
    values = torch.randn(2, 6, 3, requires_grad=True)
    tangents = torch.zeros(2, 6, 3)
    splines.cubic_hermite(values, tangents, at(0.5, values)).sum().backward()  # t_s = 2.5
    touched = values.grad.abs().sum((0, 2)) > 0
    assert touched.tolist() == [False, False, True, True, False, False]


@pytest.mark.parametrize(("degrees", "shrink"), [(30, 0.01), (120, 0.30)])
def test_chord_shrink_of_finite_differences(degrees: float, shrink: float):  # F6
    """A bar that turns: how far a per-Gaussian spline pulls its ends together."""
    angles = torch.arange(4) * math.radians(degrees)
    end = torch.stack((angles.cos(), angles.sin(), torch.zeros(4)), -1)
    bar = torch.stack((end, -end))
    middle = splines.catmull_rom(bar, at(0.5, bar))
    length = (middle[0] - middle[1]).norm() / 2
    assert length < 1
    assert 1 - length.item() == pytest.approx(shrink, abs=0.01 if degrees == 30 else 0.06)
    if degrees == 30:
        assert 1 - length.item() < 0.02


def test_slerp_of_alternating_signs():  # F4
    q = torch.nn.functional.normalize(torch.randn(6, 4), dim=-1)
    for r in (0.0, 0.3, 0.5, 1.0):
        torch.testing.assert_close(
            quats_to_matrices(slerp(q, -q, r)), quats_to_matrices(q), atol=1e-5, rtol=0
        )


def test_slerp_equal_and_opposite_turns_are_finite():  # F5
    for other in ([1.0, 0, 0, 0], [0.0, 0, 0, 1.0], [-1.0, 0, 0, 0]):
        a = torch.tensor([1.0, 0, 0, 0], requires_grad=True)
        b = torch.tensor(other, requires_grad=True)
        out = slerp(a, b, 0.4)
        out.sum().backward()
        assert torch.isfinite(out).all() and torch.isfinite(a.grad).all()
        assert torch.isfinite(b.grad).all()


def sampled(knots: torch.Tensor, tangents: torch.Tensor, frames: int) -> torch.Tensor:
    intervals = Knots(len(knots)).at_times(uniform_times(frames), knots)
    return splines.cubic_hermite(knots, tangents, intervals)


def fit(samples: torch.Tensor, keyframes: int, **settings) -> tuple[torch.Tensor, torch.Tensor]:
    return Knots(keyframes).fit(samples, uniform_times(len(samples)), **settings)


def test_fit_recovers_a_spline():
    g = torch.Generator().manual_seed(0)
    knots, tangents = torch.randn(2, 5, 3, generator=g, dtype=torch.float64)
    samples = sampled(knots, tangents, 41)
    m, tau = fit(samples, 5, free_tangents=True, smoothness=1e-9)
    torch.testing.assert_close(m, knots, atol=1e-5, rtol=0)
    torch.testing.assert_close(tau, tangents, atol=1e-4, rtol=0)
    rom = splines.finite_differences(knots[None])[0]
    m, tau = fit(sampled(knots, rom, 41), 5, free_tangents=False, smoothness=1e-9)
    torch.testing.assert_close(m, knots, atol=1e-5, rtol=0)
    torch.testing.assert_close(tau, rom, atol=1e-5, rtol=0)


@pytest.mark.parametrize("free", [True, False])
@pytest.mark.parametrize(("frames", "keyframes"), [(2, 2), (2, 5), (3, 9), (9, 9), (64, 17)])
def test_fit_is_determined_for_any_counts(frames: int, keyframes: int, free: bool):
    s = torch.linspace(0, 1, frames)
    line = torch.stack((s, 2 - s), -1)
    m, tau = fit(line, keyframes, free_tangents=free)
    expected = torch.linspace(0, 1, keyframes)
    torch.testing.assert_close(m, torch.stack((expected, 2 - expected), -1), atol=1e-4, rtol=0)
    step = 1 / (keyframes - 1)
    torch.testing.assert_close(tau[:, 0], torch.full((keyframes,), step), atol=1e-4, rtol=0)


def test_fit_weighs_samples():
    line = torch.linspace(0, 1, 21)[:, None].repeat(1, 1)
    spoilt = line.clone()
    spoilt[7] += 5
    weights = torch.ones(21)
    weights[7] = 0
    m, _ = fit(spoilt, 6, free_tangents=True, weights=weights)
    torch.testing.assert_close(m, torch.linspace(0, 1, 6)[:, None], atol=1e-4, rtol=0)


@pytest.mark.parametrize("step", [4, 2, 1])
def test_the_error_of_a_fit_falls_with_the_fourth_power_of_the_interval(step: int):  # F02
    """A sine of 6 frames through ever denser knots, against the bound |f''''| h^4 / 384."""
    phase = 2 * math.pi / 6 * torch.arange(49, dtype=torch.float64)
    wave = phase.sin()[:, None]
    keyframes = splines.keyframe_count(len(wave), step)
    values, tangents = fit(wave, keyframes, free_tangents=True, smoothness=1e-9)
    error = float((sampled(values, tangents, len(wave)) - wave).abs().max())
    assert error <= (2 * math.pi / 6 * step) ** 4 / 384
    assert step > 1 or error < 0.01
