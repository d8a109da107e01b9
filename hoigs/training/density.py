"""Applying the decisions of density control, which `hoigs.plugins.density` makes.

The rows of an entity, of its deformation and features, the optimizer's moments and the statistics
follow one index map (Refinement.change).
"""

from __future__ import annotations

from collections.abc import Mapping

import torch

from hoigs.core.interfaces.deformation import StepStatistics
from hoigs.core.interfaces.density import DensityControl, DensityStatistics, Refinement
from hoigs.core.model.entity import Entity
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.topology import AxisChange
from hoigs.training.optimizer import GroupedAdam


class EntityDensity:
    """The controller of one entity, with the statistics of the views since its last refinement."""

    def __init__(self, entity: Entity, control: DensityControl, extent: float) -> None:
        self.entity, self.control, self.extent = entity, control, extent
        self.statistics = DensityStatistics.zeros(len(entity), entity.means.device)

    def refine(
        self, current: Gaussians, optimizer: GroupedAdam, step: int, total_steps: int
    ) -> bool:
        """Apply the controller's decision, if any. True when rows changed."""
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
        """Move the Gaussians by the controller's offsets, if any."""
        offsets = self.control.perturb(
            self.entity.at_peak.detach(), step=step, total_steps=total_steps, rate=rate
        )
        if offsets is not None:
            self.entity.displace(offsets)


@torch.no_grad()
def evolve(entity: Entity, statistics: StepStatistics, optimizer: GroupedAdam) -> None:
    """Let an entity's deformation resize itself; the optimizer's moments follow."""
    changes = entity.deformation.evolve(entity.canonical.detach(), statistics)
    follow_axes(entity, changes, optimizer)


def follow_axes(entity: Entity, changes: Mapping[str, AxisChange], optimizer: GroupedAdam) -> None:
    """Move the optimizer's moments of a deformation's parameters; `changes` by parameter name."""
    for name, change in changes.items():
        optimizer.follow(entity.deformation.get_parameter(name), change)


@torch.no_grad()
def apply_refinement(entity: Entity, decision: Refinement, optimizer: GroupedAdam) -> None:
    """Apply a decision to an entity and to the optimizer's moments of its parameters."""
    if decision.change is not None and decision.canonical is not None:
        for _, parameter in entity.per_gaussian():
            optimizer.follow(parameter, decision.change)
        follow_axes(entity, entity.deformation.axis_changes(decision.change), optimizer)
        entity.apply_topology(decision.change, decision.canonical)
    if decision.reset_opacity is not None:
        ceiling = float(torch.logit(torch.tensor(decision.reset_opacity)))
        for name, parameter in entity.per_gaussian():
            if "opacity" in name:  # the canonical logits and any keyed ones
                parameter.data.clamp_(max=ceiling)
                optimizer.forget(parameter)
