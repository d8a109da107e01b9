"""The spec ex4dgs: its published settings, and that its matched profile learns and promotes."""

from __future__ import annotations

import pytest
import torch
from matched import score

from hoigs.core.model.compose import compose, compose_density
from hoigs.core.spec.schema import Spec
from hoigs.training.trainer import Trainer

MOTION = "model.scene.deformation"


def test_matched_learns_and_promotes(clip):
    overrides = [
        "train.steps=150", "train.preview_every=0", "model.scene.points=500",
        "model.scene.density.cap=600", f"{MOTION}.promote_from=30", f"{MOTION}.promote_every=40",
        f"{MOTION}.interval=4",
    ]  # fmt: skip
    spec = Spec.load("ex4dgs@matched", overrides=overrides)
    model = compose(spec, clip)
    trainer = Trainer(model, clip, spec.train, density=compose_density(spec, clip))
    untrained = score(model, clip)
    trainer.train()
    assert score(model, clip) > untrained + 7
    assert not trainer.guard.skipped
    entity = model.entity("scene")
    rows = entity.deformation.rows
    assert 3 <= len(rows) < 0.2 * len(entity)
    keys = entity.deformation.keyframe_means
    line = keys[:, :1] + (keys[:, -1:] - keys[:, :1]) * torch.linspace(0, 1, keys.shape[1])[:, None]
    assert (keys - line).norm(dim=-1).max() > 1e-3  # they have left their lines
    for name, parameter in trainer.optimizer.names.items():
        state = trainer.optimizer.adam.state.get(parameter, {})
        assert "exp_avg" not in state or state["exp_avg"].shape == parameter.shape, name
    twin = compose(spec, clip)
    twin.entity("scene").resize(len(entity))
    twin.load_state_dict(model.state_dict())
    assert score(twin, clip) == pytest.approx(score(model, clip), abs=1e-3)


def test_native_has_the_published_settings_and_slips(clip):
    spec = Spec.load("ex4dgs", overrides=["model.scene.points=50"])
    model = compose(spec, clip).entity("scene").deformation
    assert (model.config.hemisphere, model.config.opacity_jump) == (False, True)
    assert (model.config.interval, model.config.pad, model.config.promote) == (10, 2, 0.02)
    assert spec.train.steps == 40_000
    rates = spec.train.rates
    assert rates.keyframes == rates.keyframes_final == 1.6e-4  # the schedule that never runs
    assert rates.rotation == 1e-5
    assert model.regularizer_weights == {"displacement": 1e-4, "motion": 1e-4}
    matched = compose(
        Spec.load("ex4dgs@matched", overrides=["model.scene.points=50"]), clip
    ).entity("scene")
    assert matched.deformation.config.hemisphere
    assert not matched.deformation.config.opacity_jump
