"""More points on the surface of a few."""

from __future__ import annotations

import pytest
import torch

from hoigs.core.maths.nearest import LEAST, denser


def sphere(count: int) -> torch.Tensor:
    points = torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    return points / points.norm(dim=1, keepdim=True)


def test_new_points_lie_between_the_old_ones_and_are_coloured_likewise():
    points = sphere(500)
    more, colors = denser(points, (points + 1) / 2, 1800, seed=0)
    assert len(more) == len(colors) == 1800
    assert torch.equal(more[:500], points)
    torch.testing.assert_close(colors, (more + 1) / 2)  # a colour is linear in its place here
    assert more.norm(dim=1).min() > 0.9  # on the sphere but for the chords between neighbours
    nearest = torch.cdist(more[500:], more).topk(2, largest=False).values[:, 1]
    assert nearest.median() > 0.01  # not heaps


@pytest.mark.parametrize(("have", "count"), [(50, 50), (50, 20), (LEAST - 1, 100), (0, 100)])
def test_enough_points_or_too_few_to_tell_stay_as_they_are(have, count):
    points = sphere(have)
    more, colors = denser(points, points, count, seed=0)
    assert torch.equal(more, points) and torch.equal(colors, points)


def test_the_seed_decides():
    points = sphere(40)
    first, again, other = (denser(points, points, 100, seed)[0] for seed in (0, 0, 1))
    assert torch.equal(first, again) and not torch.equal(first, other)
