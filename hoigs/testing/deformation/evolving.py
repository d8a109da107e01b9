"""Letting a deformation change its own size, as training does after every step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch

from hoigs.core.deformation import DeformationModel, StepEvidence
from hoigs.core.entity import Entity
from hoigs.core.topology import AxisChange
from hoigs.testing.deformation.subject import DeformationSubject
from hoigs.testing.material.clip import FRAMES, camera_at
from hoigs.testing.modules import Moments, perturb

STEPS = 1000


@torch.no_grad()
def evolved(
    subject: DeformationSubject, entity: Entity, moments: Moments | None = None
) -> list[Mapping[str, AxisChange]]:
    """Run `evolve` for as many steps as a short training has; what changed at each that did.

    Args:
        moments: by names of the deformation's parameters; they follow.
    """
    found: list[Mapping[str, AxisChange]] = []
    if type(entity.deformation).evolve is DeformationModel.evolve:
        return found
    perturb(entity.deformation, seed=4, size=1e-3)  # what has not moved at all is never promoted
    if moments is not None:
        moments.values = {n: p.detach().clone() for n, p in moments.parameters.items()}
    rest = entity.rest.detach()
    frames = [seen(subject, entity, i) for i in range(FRAMES)]
    for step in range(1, STEPS + 1):
        evidence = replace(frames[step % FRAMES], step=step)
        entity.deformation.set_progress(step / STEPS)
        changes = entity.deformation.evolve(rest, evidence)
        if changes:
            found.append(changes)
        for name, change in changes.items() if moments is not None else ():
            moments.follow(name, change)  # type: ignore[union-attr]
    entity.deformation.set_progress(1.0)
    return found


def seen(subject: DeformationSubject, entity: Entity, frame: int) -> StepEvidence:
    """What training saw at the first step, of one frame."""
    time = frame / (FRAMES - 1)
    return StepEvidence(
        moment=subject.at(entity, time),
        camera=camera_at(time).to(entity.means),
        error=1.0 + 0.5 * time,
        screen_gradient=torch.linspace(0, 1, 2 * len(entity)).reshape(-1, 2).to(entity.means),
        radii=torch.full_like(entity.opacity_logits.detach(), 5.0),
        step=1,
        total_steps=STEPS,
    )
