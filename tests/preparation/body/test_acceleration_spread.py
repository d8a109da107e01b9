"""Accelerations that are estimated from noisy places."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from hoigs.preparation.body.priors import JITTER, _second_differences, acceleration_spreads
from hoigs.preparation.body.priors import SLOWEST_POINT as SLOWEST

FRAMES, STEP, NOISE = 300, 1 / 30, 0.01


def moving(spread: float, seed: int, count: int = 3) -> Tensor:
    """Places of points whose accelerations are white, metres."""
    draw = torch.Generator().manual_seed(seed)
    shape = (FRAMES, count, 2)
    accelerations = spread * torch.randn(shape, generator=draw, dtype=torch.float64)
    noise = NOISE * torch.randn(shape, generator=draw, dtype=torch.float64)
    return accelerations.cumsum(0).cumsum(0) * STEP**2 + noise


def estimated(places: Tensor, known: Tensor | None = None) -> Tensor:
    steps = torch.full((FRAMES - 1,), STEP, dtype=torch.float64)
    known = torch.ones(places.shape[:2], dtype=torch.bool) if known is None else known
    otherwise = torch.full((places.shape[1],), 6.0, dtype=torch.float64)
    return acceleration_spreads(places, known, _second_differences(steps), otherwise)


@pytest.mark.parametrize("spread", [2.0, 6.0, 25.0])
def test_accelerations_are_found_under_noise(spread: float) -> None:
    """One centimetre of noise alone is 22 m/s^2 from frame to frame."""
    found = estimated(moving(spread, seed=1))
    assert found.min() > 0.6 * spread and found.max() < 1.6 * spread


def test_gaps_and_points_that_are_hardly_seen() -> None:
    places, known = moving(6.0, seed=2), torch.ones(FRAMES, 3, dtype=torch.bool)
    known[::7, 0] = False
    known[10:, 1] = False
    places = torch.where(known[..., None], places, torch.nan)
    found = estimated(places, known)
    assert 3 < found[0] < 10 and 3 < found[2] < 10
    assert found[1] == 6.0  # eight accelerations: as before


def test_what_stands_still_is_held_and_what_jitters_is_not() -> None:
    places = moving(0.0, seed=3, count=5)
    assert (estimated(places) < 2 * SLOWEST).all()
    places[:, 4] *= 3
    found = estimated(places)
    assert (found[:4] < 2 * SLOWEST).all() and found[4] == JITTER
    assert (estimated(torch.zeros(FRAMES, 2, 2, dtype=torch.float64)) == 6.0).all()
