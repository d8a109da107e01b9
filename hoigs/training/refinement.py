"""Applying a density-control decision: rows, optimizer moments and statistics move together."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from hoigs.core.deformation import StepEvidence
from hoigs.core.density import DensityControl, DensityStatistics, Refinement
from hoigs.core.entity import Entity
from hoigs.core.gaussians import Gaussians
from hoigs.core.topology import AxisChange
from hoigs.training.optimizer import GroupedAdam


class EntityDensity:
    """One entity's controller with the statistics it decides on."""

    def __init__(self, entity: Entity, control: DensityControl, extent: float) -> None:
        self.entity, self.control, self.extent = entity, control, extent
        self.statistics = DensityStatistics.zeros(len(entity), entity.means.device)

    def gather(
        self,
        screen_gradient: torch.Tensor,
        radii: torch.Tensor,
        width: int,
        height: int,
        absolute_gradient: torch.Tensor | None,
        loss: torch.Tensor,
    ) -> None:
        self.statistics.add(
            screen_gradient,
            radii,
            width,
            height,
            absolute_gradient=absolute_gradient,
            loss=loss.detach(),
        )

    def refine(
        self, current: Gaussians, optimizer: GroupedAdam, step: int, total_steps: int
    ) -> bool:
        """Ask the controller, and apply what it decides. True when the count changed."""
        decision = self.control.refine(
            self.entity.at_peak.detach(),
            current.detach(),
            self.statistics,
            step=step,
            total_steps=total_steps,
            extent=self.extent,
        )
        if decision is None:
            return False
        apply_refinement(self.entity, decision, optimizer)
        self.statistics = DensityStatistics.zeros(len(self.entity), self.entity.means.device)
        return decision.change is not None

    def perturb(self, step: int, total_steps: int, rate: float) -> None:
        """Ask the controller for offsets, and move the Gaussians by them."""
        offsets = self.control.perturb(
            self.entity.at_peak.detach(), step=step, total_steps=total_steps, rate=rate
        )
        if offsets is not None:
            self.entity.displace(offsets)


@torch.no_grad()
def evolve(entity: Entity, evidence: StepEvidence, optimizer: GroupedAdam) -> None:
    """Let an entity's deformation change its own size, and the optimizer's moments with it."""
    changes = entity.deformation.evolve(entity.rest.detach(), evidence)
    follow_axes(entity, changes, optimizer)


def follow_axes(entity: Entity, changes: Mapping[str, AxisChange], optimizer: GroupedAdam) -> None:
    """Moments of a deformation's parameters follow, by parameter name."""
    for name, change in changes.items():
        optimizer.follow(entity.deformation.get_parameter(name), change)


@torch.no_grad()
def apply_refinement(entity: Entity, decision: Refinement, optimizer: GroupedAdam) -> None:
    """Carry out one decision on an entity and on the optimizer's moments of its parameters."""
    if decision.change is not None and decision.rest is not None:
        for _, parameter in entity.per_gaussian():
            optimizer.follow(parameter, decision.change)
        follow_axes(entity, entity.deformation.axis_changes(decision.change), optimizer)
        entity.apply_topology(decision.change, decision.rest)
    if decision.reset_opacity is not None:
        ceiling = float(torch.logit(torch.tensor(decision.reset_opacity)))
        for name, parameter in entity.per_gaussian():
            if "opacity" in name:  # the rest's logits and any keyed ones
                parameter.data.clamp_(max=ceiling)
                optimizer.forget(parameter)
