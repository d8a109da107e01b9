"""DeformationSubject: a class with its settings, made for the tiny clip; and the tags that gate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from hoigs.core.context import BuildContext
from hoigs.core.deformation import DeformationModel
from hoigs.core.entity import Entity
from hoigs.core.gaussians import Gaussians
from hoigs.core.interaction import EntityKind, Residual
from hoigs.core.moment import Moment
from hoigs.core.topology import TopologyChange
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
from hoigs.testing.modules import perturb, seeded

if TYPE_CHECKING:
    from hoigs.testing.door import Options

CPU = torch.device("cpu")
RAW = tuple(f.name for f in fields(Gaussians))
COUNT = 7
INSIDE = (0.0, 0.13, 0.5, 0.77, 1.0)  # of the clip, first and last frame and between frames
OUTSIDE = (-0.6, -0.01, 1.01, 1.6)
TRAINED = tuple(i / (FRAMES - 1) for i in range(FRAMES))


@dataclass(frozen=True)
class DeformationSubject:
    """What is checked: the tiny clip's human if it provides a skeleton, else its object."""

    cls: type[DeformationModel]
    config: Any
    device: torch.device = CPU

    def __str__(self) -> str:
        return self.cls.__name__

    @cached_property
    def declared(self) -> DeformationModel:
        """One of it, for what it declares."""
        return self.entity(perturbed=False).deformation

    @property
    def kind(self) -> EntityKind:
        return "human" if "skeleton" in self.cls.provides else "object"

    def context(self) -> BuildContext:
        """What a spec would give it."""
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
        """An entity of `count` Gaussians, in eval mode; by default no longer at its start."""
        model = self.model(seed, config)
        entity = seeded(lambda: Entity(self.rest(model, count), model, kind=self.kind), seed)
        if perturbed:
            perturb(entity.deformation)
        return entity.to(device=self.device, dtype=dtype).eval()

    def rest(self, model: DeformationModel, count: int) -> Gaussians:
        """Gaussians in the space that it expects, each of a shape and colour of its own."""
        if self.kind == "human":
            surface = TinyBody().surface(count, body_track().poses.betas)
            points = surface.points
            if model.rest_space == "world":
                body, pose = TinyBody(), body_track().poses.frame(FRAMES // 2)
                corners = body(pose).vertices[body.faces[surface.faces]]
                points = (corners * surface.barycentric[..., None]).sum(1)
        else:
            track = object_track()
            points = track.points[:count]
            if model.rest_space == "world":
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
    made.declared  # noqa: B018  (the tags must be there; who cannot be made says why)
    return made


def by_name(gaussians: Gaussians) -> dict[str, Tensor]:
    return {name: getattr(gaussians, name) for name in RAW}


def require_same(what: str, got: Gaussians, wanted: Gaussians, atol: float = 2e-5) -> None:
    """Every field the same to `atol`, quaternions included, sign and all."""
    for name in RAW:
        require_close(f"{what}: {name}", getattr(got, name), getattr(wanted, name), atol=atol)


def changed_by(
    source: list[int],
    fresh: Sequence[int] = (),
    offsets: Tensor | None = None,
) -> TopologyChange:
    """An index map; `fresh` are places in the new order."""
    marks = torch.zeros(len(source), dtype=torch.bool)
    marks[list(fresh)] = True
    shifts = torch.zeros(len(source), 3) if offsets is None else offsets
    return TopologyChange(torch.tensor(source, dtype=torch.int64), marks, shifts)


def apply(entity: Entity, change: TopologyChange) -> None:
    """The change with the rest values of its sources, displaced."""
    device = entity.means.device
    offsets = change.offsets.to(entity.means)
    change = TopologyChange(change.source.to(device), change.fresh.to(device), offsets)
    rest = entity.rest[change.source]
    entity.apply_topology(change, rest.replace(means=rest.means + offsets))


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
