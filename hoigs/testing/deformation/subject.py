"""DeformationSubject: a class with its settings, for the tiny clip; and conditions of checks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.model.entity import Entity
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import EntityKind, Residual
from hoigs.core.values.topology import TopologyChange
from hoigs.testing.checks import CheckList, Need
from hoigs.testing.compare import require_close
from hoigs.testing.material.body import TinyBody
from hoigs.testing.material.clip import (
    FRAMES,
    HUMAN,
    OBJECT,
    body_track,
    moment_at,
    object_track,
    tiny_clip,
)
from hoigs.testing.modules import DeviceSubject, perturb, seeded

if TYPE_CHECKING:
    from hoigs.testing.runner import Options

RAW = tuple(f.name for f in fields(Gaussians))
COUNT = 7
INSIDE = (0.0, 0.13, 0.5, 0.77, 1.0)  # times of the clip: first and last frame, and between frames
OUTSIDE = (-0.6, -0.01, 1.01, 1.6)
TRAINED = tuple(i / (FRAMES - 1) for i in range(FRAMES))


class DeformationSubject(DeviceSubject[DeformationModel]):
    """The component under check: for the human if it provides a skeleton, else for the object."""

    @cached_property
    def declared(self) -> DeformationModel:
        """An instance, for what it declares."""
        return self.entity(perturbed=False).deformation

    @property
    def kind(self) -> EntityKind:
        return "human" if "skeleton" in self.cls.provides else "object"

    def context(self) -> BuildContext:
        """The context that a spec would pass."""
        if self.kind == "human":
            return BuildContext(HUMAN, tiny_clip(), body=TinyBody(), body_track=body_track())
        bodies = {HUMAN: TinyBody()}
        return BuildContext(OBJECT, tiny_clip(), object_track=object_track(), bodies=bodies)

    def model(self, seed: int = 0, config: Any = None) -> DeformationModel:
        config = self.config if config is None else config
        return seeded(lambda: self.cls.from_config(config, self.context()), seed)

    def entity(
        self,
        count: int = COUNT,
        *,
        seed: int = 0,
        perturbed: bool = True,
        dtype: torch.dtype = torch.float32,
        config: Any = None,
    ) -> Entity:
        """An entity of `count` Gaussians, in eval mode; by default with perturbed parameters."""
        model = self.model(seed, config)
        entity = seeded(lambda: Entity(self.canonical(model, count), model, kind=self.kind), seed)
        if perturbed:
            perturb(entity.deformation)
        return entity.to(device=self.device, dtype=dtype).eval()

    def canonical(self, model: DeformationModel, count: int) -> Gaussians:
        """Gaussians in its input space, each with its own shape and colour."""
        if self.kind == "human":
            surface = TinyBody().surface(count, body_track().poses.betas)
            points = surface.points
            if model.input_space == "world":
                body, pose = TinyBody(), body_track().poses.frame(FRAMES // 2)
                corners = body(pose).vertices[body.faces[surface.faces]]
                points = (corners * surface.barycentric[..., None]).sum(1)
        else:
            track = object_track()
            points = track.points[:count]
            if model.input_space == "world":
                points = points @ track.rotations[0].mT + track.translations[0]
        generator = torch.Generator().manual_seed(2)

        def normal(*shape: int) -> Tensor:
            return torch.randn(count, *shape, generator=generator)

        upright = torch.tensor((1.0, 0, 0, 0))
        return Gaussians(
            means=points.detach().clone(),
            quats=upright + 0.3 * normal(4),
            log_scales=0.3 * normal(3) - 3.5,
            opacity_logits=normal(),
            sh=0.3 * normal(4, 3),
        )

    def at(self, entity: Entity, time: float) -> Moment:
        return moment_at(time, entity.means.dtype, entity.means.device)

    def draw(self, entity: Entity, time: float, residual: Residual | None = None) -> Gaussians:
        """The entity at `time`."""
        return entity(self.at(entity, time), residual)


CHECKS: CheckList[DeformationSubject] = CheckList("D")


def subject(cls: type[DeformationModel], config: Any, options: Options) -> DeformationSubject:
    made = DeformationSubject(cls, config, torch.device(options.device))
    made.declared  # noqa: B018  (raises here when it cannot be built)
    return made


def by_name(gaussians: Gaussians) -> dict[str, Tensor]:
    return {name: getattr(gaussians, name) for name in RAW}


def require_same(what: str, got: Gaussians, expected: Gaussians, atol: float = 2e-5) -> None:
    """Every field the same to `atol`, also the signs of quaternions."""
    for name in RAW:
        require_close(f"{what}: {name}", getattr(got, name), getattr(expected, name), atol=atol)


def changed_by(
    source: list[int],
    fresh: Sequence[int] = (),
    offsets: Tensor | None = None,
) -> TopologyChange:
    """An index map; `fresh` are new rows."""
    marks = torch.zeros(len(source), dtype=torch.bool)
    marks[list(fresh)] = True
    shifts = torch.zeros(len(source), 3) if offsets is None else offsets
    return TopologyChange(torch.tensor(source, dtype=torch.int64), marks, shifts)


def apply(entity: Entity, change: TopologyChange) -> None:
    """Apply the change, with the canonical values of the sources plus offsets."""
    device = entity.means.device
    offsets = change.offsets.to(entity.means)
    change = TopologyChange(change.source.to(device), change.fresh.to(device), offsets)
    canonical = entity.canonical[change.source]
    entity.apply_topology(change, canonical.replace(means=canonical.means + offsets))


def continuous(subject: DeformationSubject) -> str | None:
    return None if subject.declared.continuous else "it declares continuous = False"


def provides(what: str) -> Need:
    def need(subject: DeformationSubject) -> str | None:
        return None if what in subject.declared.provides else f'it does not provide "{what}"'

    return need


def applies(part: str) -> Need:
    def need(subject: DeformationSubject) -> str | None:
        return (
            None
            if part in subject.declared.residuals
            else f'it does not declare "{part}" residuals'
        )

    return need


def leaves_out_some(subject: DeformationSubject) -> str | None:
    missing = {"means", "pose"} - subject.declared.residuals
    return None if missing else "it declares every residual"


def has_parameters(subject: DeformationSubject) -> str | None:
    trained = any(p.requires_grad for p in subject.declared.parameters())
    return None if trained else "it has no parameters"
