"""D07, D08 and D32: every parameter gets a gradient, and gradients are true."""

from __future__ import annotations

import torch
from torch import Tensor

from hoigs.core.interfaces.deformation import ProvidesField, ProvidesVelocity
from hoigs.core.model.entity import Entity
from hoigs.testing.compare import require
from hoigs.testing.deformation.evolving import evolved
from hoigs.testing.deformation.subject import (
    CHECKS,
    INSIDE,
    TRAINED,
    DeformationSubject,
    by_name,
    has_parameters,
)
from hoigs.testing.modules import (
    perturb,
    require_gradients,
    require_true_gradients,
    trained,
    weighted_sum,
)


def loss(subject: DeformationSubject, entity: Entity, time: float) -> Tensor:
    """A loss of everything that a deformation computes at a moment."""
    values = by_name(subject.draw(entity, time))
    model, moment = entity.deformation, subject.at(entity, time)
    if "velocity" in model.provides and isinstance(model, ProvidesVelocity):
        values["velocity"] = model.velocity(entity.canonical, moment)
    if "field" in model.provides and isinstance(model, ProvidesField):
        values["field"] = model.posed_field(entity.canonical, moment)[0]
    return weighted_sum(values)


@CHECKS.check("D07", has_parameters)
def every_parameter_gets_a_gradient(subject: DeformationSubject) -> None:
    """Every trained parameter gets a gradient from some moment, once heads are not zero."""
    entity = subject.entity(perturbed=False)
    evolved(subject, entity)
    perturb(entity.deformation)
    times = (*TRAINED, *INSIDE)
    require_gradients(entity.deformation, (loss(subject, entity, time) for time in times))


@CHECKS.check("D08")
def gradients_are_derivatives(subject: DeformationSubject) -> None:
    """In float64, gradients of parameters and canonical fields agree with differences."""
    entity = subject.entity(dtype=torch.float64)
    with torch.no_grad():
        aside = torch.randn(entity.means.shape, generator=torch.Generator().manual_seed(9))
        entity.means.add_(1e-3 * aside.to(entity.means))
    # canonical values of fields in `owns` are not trained
    leaves = {n.removeprefix("deformation."): p for n, p in trained(entity).items()}
    for time in (0.37, 0.81):
        require_true_gradients(
            leaves,
            lambda time=time: weighted_sum(by_name(subject.draw(entity, time))),  # type: ignore[misc]
            cut=sorted(entity.deformation.cut_gradients),
        )


@CHECKS.check("D32")
def canonical_fields_are_trained_or_owned(subject: DeformationSubject) -> None:
    """Every field of the canonical Gaussians gets a gradient, or is declared in `owns`."""
    entity = subject.entity()
    names = set(by_name(entity.canonical))
    unknown = sorted(entity.deformation.owns - names)
    require(not unknown, f"owns names {unknown}, fields are {sorted(names)}")
    entity.zero_grad()
    weighted_sum(by_name(subject.draw(entity, 0.4))).backward()
    for name in sorted(names - entity.deformation.owns):
        slope = entity.get_parameter(name).grad
        reached = slope is not None and bool((slope != 0).any())
        require(
            reached,
            f"canonical.{name} gets no gradient; list a field that is computed here in `owns`",
        )
