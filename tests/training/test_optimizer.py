"""Rates by role, schedules, and moments that follow a change of Gaussian count."""

from __future__ import annotations

import pytest
import torch

from hoigs.core.errors import SpecError
from hoigs.core.model.entity import Entity
from hoigs.core.model.scene import SceneModel
from hoigs.core.spec.train_schema import RatesSpec, WarmupSpec
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.topology import TopologyChange
from hoigs.plugins.deformation.chs import CubicHermite
from hoigs.plugins.deformation.static import Static
from hoigs.rasterizers.torch_tiles import TorchRasterizer
from hoigs.training.optimizer import GroupedAdam, Schedule, named_rates


def make_model() -> SceneModel:
    torch.manual_seed(0)
    canonical = Gaussians.from_points(torch.randn(12, 3) * 0.3 + torch.tensor([0.0, 0.0, 3.0]))
    thing = Gaussians.from_points(torch.randn(5, 3) * 0.1 + torch.tensor([0.0, 0.0, 2.0]))
    entities = {
        "scene": Entity(canonical, Static(), kind="scene"),
        "object": Entity(thing, CubicHermite(CubicHermite.Config(keyframes=4)), kind="object"),
    }
    return SceneModel(entities, rasterizer=TorchRasterizer())


def test_schedule_waits_then_decays_log_linearly():
    schedule = Schedule(start=1e-2, final=1e-4, begin=0.25)
    assert schedule.at(0.2) == 0.0
    assert schedule.at(0.5) == pytest.approx(1e-3)
    assert schedule.at(1.0) == pytest.approx(1e-4)


def test_rates_without_an_end_of_their_own_settle_in_the_last_fifth():
    model = make_model()

    def ends(settle: float) -> dict[str, list[float]]:
        adam = GroupedAdam(model, RatesSpec(settle=settle), WarmupSpec(motion=0), scene_extent=1.0)
        rates: dict[str, list[float]] = {}
        for progress in (0.0, 0.8, 0.9, 1.0):
            adam.set_progress(progress)
            for name, rate in adam.learning_rates().items():
                rates.setdefault(name, []).append(rate)
        return rates

    steady, settled = ends(1.0), ends(0.1)
    for name, _, rate, _ in named_rates(model):
        if f"{rate}_final" in RatesSpec.model_fields:
            assert settled[name] == steady[name] and steady[name][0] > steady[name][-1]
        else:
            start = steady[name][0]
            assert steady[name] == [start] * 4
            assert settled[name] == pytest.approx([start, start, start * 0.1**0.5, start * 0.1])
    assert {"opacity", "means"} <= {rate for _, _, rate, _ in named_rates(model)}


def test_people_and_objects_are_done_before_the_scene():
    model = make_model()
    adam = GroupedAdam(
        model, RatesSpec(settle=0.1), WarmupSpec(motion=0.2), 1.0, steps=1000, settled=250
    )
    alone = GroupedAdam(model, RatesSpec(settle=0.1), WarmupSpec(motion=0.2), 1.0)
    for progress in (0.04, 0.1, 0.2, 0.24, 0.4, 0.9):
        adam.set_progress(progress)
        alone.set_progress(min(1.0, 4 * progress))
        shorter = alone.learning_rates()
        alone.set_progress(progress)
        whole = alone.learning_rates()
        for name, rate in adam.learning_rates().items():
            if name.startswith("entities.scene."):
                assert rate == whole[name]
            else:
                assert rate == (pytest.approx(shorter[name]) if progress <= 0.25 else 0.0)


def test_means_travel_no_farther_in_longer_trainings():
    points = torch.randn(4, 3)
    entities = {
        kind: Entity(Gaussians.from_points(points), Static(), kind=kind)
        for kind in ("scene", "object")
    }
    model = SceneModel(entities, rasterizer=TorchRasterizer())

    def means(steps: int, settled: int | None = None) -> list[float]:
        rates = RatesSpec(means_steps=2000, by_extent=())
        adam = GroupedAdam(model, rates, WarmupSpec(), 1.0, steps=steps, settled=settled)
        return [adam.schedule_of(f"entities.{name}.means").start for name in entities]

    usual = RatesSpec().means
    assert means(1200) == [usual, usual]
    assert means(30_000) == pytest.approx([usual / 15, usual / 15])
    assert means(30_000, 4000) == pytest.approx([usual / 15, usual / 2])


def test_every_trainable_parameter_has_a_known_rate():
    model = make_model()
    found = {name: rate for name, _, rate, _ in named_rates(model)}
    trainable = {name for name, p in model.named_parameters() if p.requires_grad}
    assert set(found) == trainable
    assert set(found.values()) <= set(RatesSpec.model_fields)
    assert found["entities.scene.opacity_logits"] == "opacity"


def test_position_rate_of_the_scene_scales_with_its_extent():
    model = make_model()
    rates = RatesSpec(means=1e-3)
    adam = GroupedAdam(model, rates, WarmupSpec(), scene_extent=5.0)
    adam.set_progress(0.0)
    assert adam.learning_rates()["entities.scene.means"] == pytest.approx(5e-3)


def test_an_entity_has_rates_of_its_own():
    """By kind or by name, which wins; of the others nothing changes."""
    own = {"scene": {"scale": 0.5, "means": 0.2}, "object": {"sh": 0.3}}
    model = make_model()
    found = GroupedAdam(model, RatesSpec(by_entity=own), WarmupSpec(), 5.0).learning_rates()
    usual = GroupedAdam(model, RatesSpec(), WarmupSpec(), 5.0).learning_rates()
    changed = {name for name, rate in found.items() if rate != usual[name]}
    scene = {"entities.scene.log_scales", "entities.scene.means"}
    assert changed == scene | {"entities.object.sh"}
    assert found["entities.scene.log_scales"] == 0.5
    assert found["entities.scene.means"] == pytest.approx(0.2 * 5.0)
    both = RatesSpec(by_entity={"object": {"sh": 0.3, "scale": 0.4}, "cup": {"sh": 0.1}})
    assert (both.of("cup", "object").sh, both.of("cup", "object").scale) == (0.1, 0.4)
    assert both.of("scene", "scene") is both
    with pytest.raises(ValueError, match='no rate "scales"; did you mean "scale"'):
        RatesSpec(by_entity={"scene": {"scales": 0.1}})
    unknown = RatesSpec(by_entity={"scenne": {"scale": 0.1}})
    with pytest.raises(SpecError, match='kind "scenne"; did you mean "scene"'):
        GroupedAdam(model, unknown, WarmupSpec(), 5.0)


def test_motion_does_not_move_before_its_warmup():
    model = make_model()
    adam = GroupedAdam(model, RatesSpec(), WarmupSpec(motion=0.5), scene_extent=1.0)
    waiting = [n for n, _, rate, _ in named_rates(model) if rate == "keyframes"]
    assert waiting, "the spline declares keyframes"
    before = {n: adam.names[n].detach().clone() for n in waiting}
    adam.set_progress(0.1)
    for parameter in adam.names.values():
        parameter.grad = torch.ones_like(parameter)
    adam.step()
    assert all(torch.equal(adam.names[n], before[n]) for n in waiting)


def test_moments_follow_rows_and_fresh_rows_start_at_zero():
    model = make_model()
    adam = GroupedAdam(model, RatesSpec(), WarmupSpec(), scene_extent=1.0)
    parameter = adam.names["entities.scene.means"]
    for p in adam.names.values():
        p.grad = torch.randn_like(p)
    adam.step()
    old = adam.adam.state[parameter]["exp_avg"].clone()
    change = TopologyChange(
        torch.tensor([3, 1, 1]), torch.tensor([False, False, True]), torch.zeros(3, 3)
    )
    adam.follow(parameter, change)
    new = adam.adam.state[parameter]["exp_avg"]
    assert torch.equal(new[:2], old[[3, 1]])
    assert torch.equal(new[2], torch.zeros(3))
    assert float(old[1].abs().min()) > 0


@pytest.mark.parametrize(
    "device",
    [
        "meta",
        pytest.param(
            "cuda",
            marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"),
        ),
    ],
)
def test_restored_moments_lie_where_their_parameters_do(device):
    model = make_model()
    optimizer = GroupedAdam(model, RatesSpec(), WarmupSpec(), 1.0)
    for parameter in optimizer.names.values():
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    stored = {name: tensor.cpu() for name, tensor in optimizer.tensors().items()}
    moved = GroupedAdam(make_model().to(device), RatesSpec(), WarmupSpec(), 1.0)
    moved.load_tensors(stored)
    assert {tensor.device.type for tensor in moved.tensors().values()} == {device}
    assert moved.tensors().keys() == stored.keys()


def test_which_rates_are_in_units_of_the_extent():
    model = make_model()
    rates = RatesSpec(means=1e-3, opacity=0.05, by_extent=("opacity",))
    adam = GroupedAdam(model, rates, WarmupSpec(), scene_extent=5.0)
    adam.set_progress(0.0)
    rate = adam.learning_rates()
    assert rate["entities.scene.means"] == pytest.approx(1e-3)
    assert rate["entities.scene.opacity_logits"] == pytest.approx(0.25)
    with pytest.raises(ValueError, match='no rate "opacit"; did you mean "opacity"'):
        RatesSpec(by_extent=("opacit",))


def with_bands(sh_rest: float) -> tuple[GroupedAdam, torch.nn.Parameter]:
    canonical = Gaussians.from_points(torch.randn(6, 3), sh_degree=2)
    model = SceneModel({"scene": Entity(canonical, Static())}, rasterizer=TorchRasterizer())
    adam = GroupedAdam(model, RatesSpec(sh_rest=sh_rest), WarmupSpec(), scene_extent=1.0)
    adam.set_progress(0.0)
    return adam, adam.names["entities.scene.sh"]


def test_higher_harmonics_have_a_share_of_the_rate():
    torch.manual_seed(0)
    gradient = torch.randn(6, 9, 3)
    steps = []
    for share in (1.0, 0.05):
        adam, sh = with_bands(share)
        before = sh.detach().clone()
        for _ in range(3):  # moments are the same in both
            sh.grad = gradient.clone()
            adam.step()
        steps.append(sh.detach() - before)
    torch.testing.assert_close(steps[1][:, :1], steps[0][:, :1])
    torch.testing.assert_close(steps[1][:, 1:], 0.05 * steps[0][:, 1:], rtol=1e-3, atol=1e-7)


def test_harmonics_wait_for_their_degree():
    adam, sh = with_bands(1.0)
    before = sh.detach().clone()
    sh.grad = torch.ones_like(sh)
    adam.step(sh_degree=1)
    moved = (sh.detach() - before).abs().amax((0, 2)) > 0
    assert moved.tolist() == [True] * 4 + [False] * 5
    sh.grad = torch.ones_like(sh)
    adam.step()
    assert ((sh.detach() - before).abs().amax((0, 2)) > 0).all()


def test_parameters_of_one_schedule_are_stepped_as_if_each_were_alone():
    together, alone = make_model(), make_model()
    alone.load_state_dict(together.state_dict())
    ours = GroupedAdam(together, RatesSpec(), WarmupSpec(), scene_extent=2.0)
    assert len(ours.adam.param_groups) < len(ours.names)
    ours.set_progress(0.6)
    rates = ours.learning_rates()
    theirs = {name: p for name, p, _, _ in named_rates(alone)}
    single = torch.optim.Adam(
        [{"params": [p], "lr": rates[name]} for name, p in theirs.items()], eps=1e-15, fused=True
    )
    generator = torch.Generator().manual_seed(0)
    for _ in range(3):
        for name, parameter in ours.names.items():
            parameter.grad = torch.randn(parameter.shape, generator=generator)
            theirs[name].grad = parameter.grad.clone()
        ours.step()
        single.step()
    for name, parameter in ours.names.items():
        assert torch.equal(parameter, theirs[name]), name
