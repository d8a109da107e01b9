"""Every density control in a short training: the loss falls, the count obeys, runs resume."""

from __future__ import annotations

import pytest
import torch
from small_clip import small_clip

from hoigs.core.errors import RenderError, SpecError
from hoigs.core.interfaces.density import DensityControl
from hoigs.core.interfaces.rasterizer import Capabilities
from hoigs.core.model.entity import Entity
from hoigs.core.model.scene import SceneModel
from hoigs.core.spec.train_schema import LossSpec, RatesSpec, TrainSpec
from hoigs.core.values.clip import Clip
from hoigs.core.values.gaussians import Gaussians
from hoigs.plugins.deformation.chs import CubicHermite
from hoigs.plugins.deformation.static import Static
from hoigs.plugins.density.adc import AbsoluteGradientDensity, AdaptiveDensity
from hoigs.plugins.density.budget import BudgetDensity
from hoigs.plugins.density.mcmc import McmcDensity
from hoigs.plugins.density.none import NoDensity
from hoigs.rasterizers.torch_tiles import TorchRasterizer
from hoigs.training.trainer import StepReport, Trainer

STEPS, SHORT, CAP = 60, 20, 150
# several times the usual rates, so that tens of steps tell
RATES = RatesSpec(means=2e-3, sh=0.05, opacity=0.1, scale=0.02)
CONTROLS = {
    "adc": lambda **kw: AdaptiveDensity(
        AdaptiveDensity.Config(**{"interval": 10, "stop": 0.6, "cap": CAP} | kw)
    ),
    "absgrad": lambda **kw: AbsoluteGradientDensity(
        AbsoluteGradientDensity.Config(**{"interval": 10, "stop": 0.6, "cap": CAP} | kw)
    ),
    "mcmc": lambda **kw: McmcDensity(
        McmcDensity.Config(**{"interval": 5, "growth": 0.1, "cap": CAP} | kw)
    ),
    "budget": lambda **kw: BudgetDensity(
        BudgetDensity.Config(count=CAP, **{"interval": 10, "stop": 0.6} | kw)
    ),
}


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def clip() -> Clip:
    return small_clip()


def trainer(
    clip: Clip, control: DensityControl | None, *, moves: bool = False, steps: int = STEPS
) -> Trainer:
    canonical = Gaussians.from_points(clip.points, clip.point_colors, opacity=0.3)
    motion = CubicHermite(CubicHermite.Config(keyframes=3)) if moves else Static()
    entity = Entity(canonical, motion, kind="scene")
    model = SceneModel(
        {"scene": entity}, rasterizer=TorchRasterizer(TorchRasterizer.Config(tile_size=32))
    )
    spec = TrainSpec(
        steps=steps,
        rates=RATES,
        log_every=1,
        preview_every=0,
        loss=LossSpec(lambda_dssim=0.0),
        warmup={"motion": 0.0},
    )
    density = {} if control is None else {"scene": control}
    return Trainer(model, clip, spec, density=density)


def train(started: Trainer) -> list[StepReport]:
    reports: list[StepReport] = []
    started.train(reports.append)
    return reports


def mean_loss(reports: list[StepReport]) -> float:
    return sum(r.losses["scene"] for r in reports) / len(reports)


@pytest.fixture(scope="module")
def fixed(clip: Clip) -> float:
    """The loss at the end without any density control."""
    return mean_loss(train(trainer(clip, NoDensity()))[-6:])


@pytest.mark.parametrize("name", CONTROLS)
def test_each_improves_on_a_fixed_count(clip: Clip, fixed: float, name: str) -> None:
    reports = train(trainer(clip, CONTROLS[name]()))
    counts = [r.counts["scene"] for r in reports]
    first, last = mean_loss(reports[:6]), mean_loss(reports[-6:])
    assert last < 0.7 * first
    assert last < 0.98 * fixed
    assert max(counts) <= CAP
    assert counts[-1] > 120
    if name == "budget":
        assert counts[-1] == CAP
    assert all(torch.isfinite(torch.tensor(r.loss)) for r in reports)


@pytest.mark.parametrize("name", ["absgrad", "mcmc", "budget"])
def test_keyframed_scenes_train_too(clip: Clip, name: str) -> None:
    started = trainer(clip, CONTROLS[name](interval=4), moves=True, steps=SHORT)
    reports = train(started)
    entity = started.model.entity("scene")
    count = reports[-1].counts["scene"]
    assert 60 < count <= CAP
    assert mean_loss(reports[-6:]) < mean_loss(reports[:6])
    for _, parameter in entity.per_gaussian():
        assert len(parameter) == count
        assert torch.isfinite(parameter).all()


@pytest.mark.parametrize("name", CONTROLS)
def test_a_resumed_run_equals_the_unbroken_one(clip: Clip, name: str) -> None:
    make = lambda: trainer(clip, CONTROLS[name](interval=4), steps=SHORT)  # noqa: E731
    whole, broken, saved = make(), make(), []
    whole.train(lambda report: saved.append(_copied(whole)) if report.step == 6 else None)
    assert whole.model.count()["scene"] > saved[0].meta["counts"]["scene"] > 60
    torch.manual_seed(99)
    broken.resume(saved[0])
    broken.train()
    expected, found = whole.model.state_dict(), broken.model.state_dict()
    assert all(torch.equal(found[key], value) for key, value in expected.items())


def _copied(started: Trainer):
    checkpoint = started.checkpoint()
    for key, value in checkpoint.tensors.items():
        checkpoint.tensors[key] = value.detach().clone()
    return checkpoint


def test_penalties_of_a_controller_join_the_loss_and_obey_the_spec(clip: Clip) -> None:
    started = trainer(clip, McmcDensity(McmcDensity.Config(opacity_weight=0.5, scale_weight=0.0)))
    result = started.objective(clip[0], clip[0].camera, started.generator)
    assert result.weights["regularizer/scene/opacity_l1"] == 0.5
    assert "regularizer/scene/scale_l1" not in result.terms
    opacities = started.model.entity("scene").canonical.opacities
    torch.testing.assert_close(result.terms["regularizer/scene/opacity_l1"], opacities.mean())
    started.objective.spec = LossSpec(regularizers={"opacity_l1": 0.125})
    result = started.objective(clip[0], clip[0].camera, started.generator)
    assert result.weights["regularizer/scene/opacity_l1"] == 0.125


def test_absolute_gradients_are_gathered_only_when_asked_for(clip: Clip) -> None:
    for name, asked in (("adc", False), ("absgrad", True)):
        started = trainer(clip, CONTROLS[name]())
        started._step()
        statistics = started.density["scene"].statistics
        assert bool((statistics.absolute_sum > 0).any()) == asked
        if asked:
            seen = statistics.visible_count > 0
            assert (statistics.absolute_sum >= statistics.gradient_sum * 0.999)[seen].all()
        assert (statistics.loss_sum > 0).any()


def test_a_backend_that_cannot_is_refused_before_anything_runs(
    clip: Clip, monkeypatch: pytest.MonkeyPatch
) -> None:
    cannot = Capabilities(frozenset({"cpu"}), frozenset({"float32"}), True, True)
    monkeypatch.setattr(TorchRasterizer, "capabilities", cannot)
    with pytest.raises(RenderError, match="AbsoluteGradientDensity needs absolute"):
        trainer(clip, AbsoluteGradientDensity())


def test_the_spec_names_the_place(clip: Clip, monkeypatch: pytest.MonkeyPatch) -> None:
    from hoigs.core.model.compose import compose_density
    from hoigs.core.registry.registry import default_registry
    from hoigs.core.spec.schema import Spec

    changes = ["rasterizer.use=rasterizer:torch", "model.scene.density.use=density:absgrad"]
    spec = Spec.load("static", overrides=changes, registry=default_registry())
    assert compose_density(spec, clip)["scene"].absolute_gradients
    cannot = Capabilities(frozenset({"cpu"}), frozenset({"float32"}), True, True)
    monkeypatch.setattr(TorchRasterizer, "capabilities", cannot)
    with pytest.raises(SpecError, match=r"scene\.density: .*TorchRasterizer does not compute"):
        compose_density(spec, clip)


def test_noise_takes_the_rate_of_the_positions(clip: Clip) -> None:
    still, moving = trainer(clip, None), trainer(clip, None, moves=True)
    for started in (still, moving):
        started.optimizer.set_progress(0.0)
    rates = still.spec.rates
    extent = clip.extent()
    assert still.optimizer.position_rate("scene") == pytest.approx(rates.means * extent)
    assert moving.optimizer.position_rate("scene") == pytest.approx(rates.keyframes)
    assert still.optimizer.position_rate("nobody") == 0
