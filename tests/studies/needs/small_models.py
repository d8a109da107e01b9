"""A tiny clip's models, and what looks at them, for tests of pruning."""

from __future__ import annotations

import torch

from hoigs.core.model.compose import compose
from hoigs.core.registry.registry import default_registry
from hoigs.core.spec.schema import Spec
from hoigs.core.values.clip import Clip
from hoigs.studies.needs.search_space import StepBudget
from hoigs.studies.needs.trial import Trained, Validator

NAME = (
    "builtin:lift-and-swing?frames=14&width=32&fps=4&samples=1&edge_samples=1&held_out_views=0"
    "&test_frames=3&scene_points=300&object_points=120"
)
GIVEN = (
    "train.steps=30",
    "train.preview_every=0",
    "model.human.points=200",
    "model.human.deformation.resolution=8",
)


def as_composed(clip: Clip, *changes: str) -> Trained:
    registry = default_registry()
    spec = Spec.load("hoigs", overrides=(*GIVEN, *changes), registry=registry)
    model = compose(spec, clip, registry)
    model.eval()
    model.set_progress(1.0)
    return Trained(spec, model, clip, registry)


def validator_of(clip: Clip) -> Validator:
    return Validator(clip, clip.split["train"][2:8:3], StepBudget(1e6))


def drawn(trained: Trained, position: int) -> torch.Tensor:
    with torch.no_grad():
        return trained.model.render(
            trained.clip.moments[position], trained.clip.cameras[position]
        ).color
