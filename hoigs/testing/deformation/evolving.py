"""Running `evolve` as training does after every step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch

from hoigs.core.interfaces.deformation import DeformationModel, StepStatistics
from hoigs.core.model.entity import Entity
from hoigs.core.values.topology import AxisChange
from hoigs.testing.deformation.subject import DeformationSubject
from hoigs.testing.material.clip import FRAMES, camera_at
from hoigs.testing.modules import Moments, perturb

STEPS = 1000


@torch.no_grad()
def evolved(
    subject: DeformationSubject, entity: Entity, moments: Moments | None = None
) -> list[Mapping[str, AxisChange]]:
    """Run `evolve` for the steps of a short training; returns the changes of each step with any.

    Args:
        moments: of the deformation's parameters; they follow the changes.
    """
    found: list[Mapping[str, AxisChange]] = []
    if type(entity.deformation).evolve is DeformationModel.evolve:
        return found
    perturb(
        entity.deformation, seed=4, size=1e-3
    )  # a deformation may evolve only parameters that have moved
    if moments is not None:
        moments.values = {n: p.detach().clone() for n, p in moments.parameters.items()}
    canonical = entity.canonical.detach()
    frames = [statistics_of(subject, entity, i) for i in range(FRAMES)]
    for step in range(1, STEPS + 1):
        statistics = replace(frames[step % FRAMES], step=step)
        entity.deformation.set_progress(step / STEPS)
        changes = entity.deformation.evolve(canonical, statistics)
        if changes:
            found.append(changes)
        for name, change in changes.items() if moments is not None else ():
            moments.follow(name, change)  # type: ignore[union-attr]
    entity.deformation.set_progress(1.0)
    return found


def statistics_of(subject: DeformationSubject, entity: Entity, frame: int) -> StepStatistics:
    """The statistics of one frame at the first step."""
    time = frame / (FRAMES - 1)
    return StepStatistics(
        moment=subject.at(entity, time),
        camera=camera_at(time).to(entity.means),
        error=1.0 + 0.5 * time,
        screen_gradient=torch.linspace(0, 1, 2 * len(entity)).reshape(-1, 2).to(entity.means),
        radii=torch.full_like(entity.opacity_logits.detach(), 5.0),
        step=1,
        total_steps=STEPS,
    )
