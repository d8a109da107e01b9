"""Bench: a small model of a spec on a tiny clip, for checks that need a model and few steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import torch

from hoigs.core.interfaces.density import DensityControl
from hoigs.core.model.compose import compose, compose_density
from hoigs.core.model.entity import FIELDS
from hoigs.core.model.scene import SceneModel
from hoigs.core.registry.registry import default_registry
from hoigs.core.spec.schema import Spec
from hoigs.core.values.clip import Clip
from hoigs.core.values.moment import Moment
from hoigs.studies.stress.capability import Capability, capabilities
from hoigs.studies.stress.sizes import small_settings
from hoigs.training.trainer import Trainer

TINY = (
    "builtin:figure-eight?frames=12&width=48&fps=6&samples=1&edge_samples=1&held_out_views=0"
    "&test_frames=3&scene_points=600&object_points=200"
)
POINTS, STEPS = 400, 12


@dataclass(frozen=True)
class Bench:
    """A composed model for the checks of a spec.

    Attributes:
        source: name or file of the spec. overrides: of the spec.
        spec: resolved, small. clip: tiny. model: composed, not trained.
    """

    source: str
    overrides: tuple[str, ...]
    plugins: tuple[str, ...]
    spec: Spec
    clip: Clip
    model: SceneModel
    density: Mapping[str, DensityControl]

    @staticmethod
    def compose(
        source: str,
        overrides: Sequence[str] = (),
        plugins: Sequence[str] = (),
        *,
        clip: Clip | None = None,
        more: Sequence[str] = (),
    ) -> Bench:
        """A spec on the tiny clip.

        Args:
            clip: in place of the tiny clip. more: overrides of all other settings.

        Raises:
            SpecError: the spec is invalid, or does not fit a clip of one human and one object.
        """
        registry = default_registry([Path(p) for p in plugins])
        clip = clip or tiny_clip()
        own = Spec.load(source, overrides=list(overrides), registry=registry)
        settings = [*small_settings(own, POINTS, STEPS), *overrides, f"train.steps={STEPS}", *more]
        spec = Spec.load(source, overrides=settings, registry=registry)
        model = compose(spec, clip, registry)
        density = compose_density(spec, clip, registry)
        return Bench(source, tuple(overrides), tuple(plugins), spec, clip, model, density)

    def anew(self, clip: Clip | None = None, *more: str) -> Bench:
        """The same spec composed again, on this clip or another."""
        return Bench.compose(self.source, self.overrides, self.plugins, clip=clip, more=more)

    @property
    def capabilities(self) -> frozenset[Capability]:
        return capabilities(self.spec, self.model, self.density)

    def trained(self) -> Trainer:
        """A trainer that has trained this model for all its steps."""
        trainer = Trainer(self.model, self.clip, self.spec.train, density=self.density)
        trainer.train()
        return trainer

    def at(self, time: float) -> Moment:
        """A moment at any time, with the body poses of the nearest frame."""
        last = len(self.clip) - 1
        nearest = self.clip.moments[min(max(round(time * last), 0), last)]
        return replace(nearest, time=time)

    def shaken(self, size: float = 0.02) -> SceneModel:
        """The model with noise on every parameter but the canonical Gaussians, so that heads that
        start at zero have gradients."""
        generator = torch.Generator().manual_seed(0)
        with torch.no_grad():
            for name, parameter in self.model.named_parameters():
                if name.rpartition(".")[2] not in FIELDS or ".deformation." in name:
                    parameter.add_(size * torch.randn(parameter.shape, generator=generator))
        return self.model


@cache
def tiny_clip(more: str = "") -> Clip:
    """The tiny clip, with more settings of its generator."""
    from hoigs.runs.clip_source import read_clip

    return read_clip(f"{TINY}&{more}" if more else TINY)
