"""deformation:shared-harmonics: what shines in a few ways needs few numbers for it."""

from __future__ import annotations

import pytest
import torch

from hoigs.core.model.entity import Entity
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.topology import TopologyChange
from hoigs.plugins.deformation.shared_harmonics import SharedHarmonics

COUNT = 30


def entity(lobes: int = 3) -> Entity:
    torch.manual_seed(0)
    canonical = Gaussians.from_points(
        torch.randn(COUNT, 3, dtype=torch.float64), scales=0.1, sh_degree=2
    )
    return Entity(canonical, SharedHarmonics(SharedHarmonics.Config(lobes=lobes)))


def test_starts_as_the_base_colour_and_learns_any_mixture_of_so_many_lobes():
    made = entity()
    assert not made.sh.requires_grad
    torch.testing.assert_close(made(Moment(0.3)).sh, made.canonical.sh)
    goal = torch.randn(COUNT, 3, dtype=torch.float64) @ torch.randn(3, 24, dtype=torch.float64)
    errors = {}
    for count in (2, 3):
        made = entity(count)
        adam = torch.optim.LBFGS(made.deformation.parameters(), max_iter=400)

        def loss(made=made, adam=adam) -> torch.Tensor:
            adam.zero_grad()
            error = (made(Moment(0.3)).sh[:, 1:].flatten(1) - goal).square().mean()
            error.backward()
            return error

        adam.step(loss)
        errors[count] = float(loss().detach()) / float(goal.square().mean())
    assert errors[3] < 1e-4 and errors[2] > 0.02


def test_rows_take_their_shares_along():
    made = entity()
    torch.nn.init.normal_(made.deformation.shares)
    before = made(Moment(0.0)).sh
    mask = torch.arange(COUNT) % 3 == 0
    made.apply_topology(TopologyChange.keep(mask), made.canonical[mask])
    torch.testing.assert_close(made(Moment(1.0)).sh, before[mask])


@pytest.mark.parametrize(("degree", "lobes"), [(0, 0), (1, 3), (2, 3)])
def test_as_many_bands_as_the_rest_has(degree, lobes):
    canonical = Gaussians.from_points(torch.randn(4, 3), torch.rand(4, 3), sh_degree=degree)
    made = Entity(canonical, SharedHarmonics())
    assert made.deformation.shares.shape == (4, lobes)
    torch.testing.assert_close(made(Moment(0.0)).sh, canonical.sh)
