"""D10 to D14 and D25: pruned, cloned, split and relocated rows, with optimizer moments."""

from __future__ import annotations

import torch

from hoigs.core.model.entity import Entity
from hoigs.core.values.topology import TopologyChange
from hoigs.testing.compare import require
from hoigs.testing.deformation.evolving import evolved
from hoigs.testing.deformation.subject import (
    CHECKS,
    INSIDE,
    RAW,
    DeformationSubject,
    apply,
    changed_by,
    require_same,
)
from hoigs.testing.modules import Moments, trained

OFFSET = 1e-3  # metres


def require_rows(subject: DeformationSubject, change: TopologyChange) -> None:
    """After the change, each row equals its source's, at every moment."""
    before, after = subject.entity(), subject.entity()
    for entity in (before, after):
        evolved(subject, entity)
    apply(after, change)
    for time in INSIDE:
        expected = subject.draw(before, time)[change.source]
        got = subject.draw(after, time)
        require(len(got) == len(change), f"expected {len(change)} rows, got {len(got)}")
        require_same(f"at {time}", got, expected)


@CHECKS.check("D10")
def pruning_keeps_other_rows(subject: DeformationSubject) -> None:
    """Pruning does not change the other rows."""
    require_rows(subject, changed_by([0, 2, 3, 5]))


@CHECKS.check("D11")
def clones_equal_their_sources(subject: DeformationSubject) -> None:
    """Clones, appended at the end, look and move as their sources."""
    require_rows(subject, changed_by([0, 1, 2, 3, 4, 5, 6, 2, 5], fresh=[7, 8]))


@CHECKS.check("D12")
def split_children_are_offset(subject: DeformationSubject) -> None:
    """Children of a split are about their offset away from the source, at every moment."""
    before = subject.entity(dtype=torch.float64)
    after = subject.entity(dtype=torch.float64)
    for entity in (before, after):
        evolved(subject, entity)
    offsets = torch.zeros(8, 3)
    offsets[6:] = OFFSET * torch.tensor([[0.6, -0.64, 0.48], [-0.48, 0.6, 0.64]])
    change = changed_by([0, 1, 2, 3, 5, 6, 4, 4], fresh=[6, 7], offsets=offsets)
    apply(after, change)
    for time in INSIDE:
        source, children = subject.draw(before, time)[[4, 4]], subject.draw(after, time)[6:]
        apart = (children.means - source.means).norm(dim=-1)
        # where means are the canonical ones, a steep field may move children farther apart
        far = 5.0 if "means" in after.deformation.owns else torch.inf
        require(
            ((apart > 0.2 * OFFSET) & (apart < far * OFFSET)).all(),
            f"children {OFFSET:g} m from their source in canonical space are {apart.tolist()} m "
            f"from it at {time}; add TopologyChange.offsets to all kept positions",
        )


@CHECKS.check("D13")
def relocated_rows_equal_their_sources(subject: DeformationSubject) -> None:
    """Relocated rows equal their new sources; the count stays."""
    require_rows(subject, changed_by([0, 3, 2, 3, 4, 5, 3], fresh=[1, 3, 6]))


def follow(entity: Entity, change: TopologyChange, moments: Moments) -> None:
    """Update the moments as training does before rows change."""
    for name, _ in entity.per_gaussian():
        moments.follow(name, change)
    for name, axis in entity.deformation.axis_changes(change).items():
        moments.follow(f"deformation.{name}", axis)


@CHECKS.check("D14")
def optimizer_moments_follow(subject: DeformationSubject) -> None:
    """Optimizer moments follow their rows; parameters stay the same objects."""
    entity = subject.entity()
    evolved(subject, entity)
    moments = Moments(trained(entity))
    change = changed_by([0, 2, 3, 5, 2, 6, 1, 4], fresh=[4])
    follow(entity, change, moments)
    apply(entity, change)
    now = {name: entity.get_parameter(name) for name in moments.parameters}
    for name in RAW:  # canonical values, which the kit itself has set
        now.pop(name, None)
    moments.require_in_step(now)


@CHECKS.check("D25")
def evolve_reports_its_changes(subject: DeformationSubject) -> str | None:
    """`evolve` returns every change of size, and rows still follow density control."""
    entity = subject.entity()
    before = subject.draw(entity, 0.4)
    every = dict(entity.deformation.named_parameters())
    moments = Moments({n: p for n, p in every.items() if p.requires_grad})
    changes = evolved(subject, entity, moments)
    require(
        set(dict(entity.deformation.named_parameters())) == set(every),
        "evolve adds or removes parameters; change their size",
    )
    for name, parameter in moments.parameters.items():
        now = entity.deformation.get_parameter(name)
        require(now is parameter, f"evolve made {name} another Parameter object; change its data")
        require(
            now.shape == moments.values[name].shape,
            f"after evolve {name} is {list(now.shape)}, its moments "
            f"{list(moments.values[name].shape)}; return an AxisChange for it",
        )
    after = subject.draw(entity, 0.4)
    require(len(after) == len(before), f"{len(before)} rows became {len(after)} by evolve")
    return f"it changed its size {len(changes)} times" if changes else None
