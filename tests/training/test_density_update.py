"""Decisions of density control as training applies them: rows and Adam's moments."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from hoigs.core.interfaces.density import DensityControl, Refinement
from hoigs.core.model.entity import Entity
from hoigs.core.model.scene import SceneModel
from hoigs.core.spec.train_schema import RatesSpec, WarmupSpec
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.plugins.deformation.chs import CubicHermite
from hoigs.plugins.deformation.static import Static
from hoigs.plugins.density.adc import AdaptiveDensity
from hoigs.plugins.density.budget import BudgetDensity
from hoigs.plugins.density.mcmc import McmcDensity
from hoigs.rasterizers.torch_tiles import TorchRasterizer
from hoigs.training.density import EntityDensity
from hoigs.training.optimizer import GroupedAdam

COUNT, MOMENT = 40, Moment(0.4)


def model_and_adam(moves: bool) -> tuple[SceneModel, GroupedAdam]:
    """Some rows nearly transparent at all times; one step taken with gradients of all sizes."""
    generator = torch.Generator().manual_seed(0)
    canonical = Gaussians.from_points(torch.randn(COUNT, 3, generator=generator), opacity=0.4)
    canonical.opacity_logits[::4] = -9.0
    entity = Entity(
        canonical,
        CubicHermite(CubicHermite.Config(keyframes=3)) if moves else Static(),
        kind="scene",
    )
    model = SceneModel({"scene": entity}, rasterizer=TorchRasterizer())
    adam = GroupedAdam(model, RatesSpec(), WarmupSpec(motion=0.0), scene_extent=1.0)
    adam.set_progress(0.0)
    for parameter in adam.names.values():
        parameter.grad = torch.randn(parameter.shape, generator=generator)
    adam.step()
    return model, adam


def moments(adam: GroupedAdam) -> dict[nn.Parameter, tuple[Tensor, Tensor]]:
    state = adam.adam.state
    return {
        p: (state[p]["exp_avg"].clone(), state[p]["exp_avg_sq"].clone())
        for p in adam.names.values()
    }


class Kept(DensityControl):
    """Remembers what another decided."""

    def __init__(self, control: DensityControl) -> None:
        self.control, self.decision = control, None

    def refine(self, *args, **kwargs) -> Refinement | None:
        self.decision = self.control.refine(*args, **kwargs)
        return self.decision


@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize(
    "control",
    [
        McmcDensity(McmcDensity.Config(growth=0.2)),
        BudgetDensity(BudgetDensity.Config(count=60, stop=0.1)),
        AdaptiveDensity(AdaptiveDensity.Config(threshold=1e-9)),
    ],
    ids=["mcmc", "budget", "adc"],
)
def test_moments_follow_their_rows(control: DensityControl, moves: bool) -> None:
    model, adam = model_and_adam(moves)
    entity, kept = model.entity("scene"), Kept(control)
    density = EntityDensity(entity, kept, extent=100.0)  # all are small: clones
    loss = torch.tensor(0.3)
    density.statistics.add(torch.rand(COUNT, 2), torch.ones(COUNT), 64, 64, loss=loss)
    before = moments(adam)
    assert density.refine(entity(MOMENT).detach(), adam, 100, 1000)
    change = kept.decision.change
    assert 0 < int(change.fresh.sum()) < len(change)
    for parameter, (mean, square) in before.items():
        state = adam.adam.state[parameter]
        assert len(parameter) == len(change)
        for key, old in (("exp_avg", mean), ("exp_avg_sq", square)):
            assert (old != 0).all()
            assert torch.equal(state[key][~change.fresh], old[change.source][~change.fresh])
            assert (state[key][change.fresh] == 0).all()
    assert len(density.statistics.loss_sum) == len(change)
    assert (density.statistics.loss_sum == 0).all()


def test_nothing_dead_is_left_after_relocation() -> None:
    for moves in (False, True):
        model, adam = model_and_adam(moves)
        entity = model.entity("scene")
        density = EntityDensity(entity, McmcDensity(McmcDensity.Config(growth=0.0)), extent=1.0)
        assert int((entity.at_peak.opacities <= 0.005).sum()) == 10
        assert density.refine(entity(MOMENT).detach(), adam, 100, 1000)
        assert len(entity) == COUNT
        assert int((entity.at_peak.opacities < 0.0049).sum()) == 0


@pytest.mark.parametrize("moves", [False, True])
def test_noise_moves_rows_and_leaves_moments(moves: bool) -> None:
    model, adam = model_and_adam(moves)
    entity = model.entity("scene")
    density = EntityDensity(entity, McmcDensity(), extent=1.0)
    before, places = moments(adam), entity(MOMENT).detach().clone()
    density.perturb(3, 1000, 0.0)
    assert torch.equal(entity(MOMENT).means, places.means)
    density.perturb(3, 1000, adam.position_rate("scene"))
    moved = (entity(MOMENT).means - places.means).detach().norm(dim=1)
    dead = places.opacities <= 0.005
    assert float(moved[dead].min()) > 100 * float(moved[~dead].max())
    assert torch.equal(entity(MOMENT).quats, places.quats)
    for parameter, (mean, square) in moments(adam).items():
        assert torch.equal(mean, before[parameter][0])
        assert torch.equal(square, before[parameter][1])
