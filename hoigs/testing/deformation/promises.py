"""D19, D24, D26, D31, D33 and D34: inputs, penalties, progress, rates and caches."""

from __future__ import annotations

import torch
from torch import Tensor

from hoigs.core.interaction import Residual
from hoigs.core.train_spec import RatesSpec
from hoigs.testing.compare import require, require_finite
from hoigs.testing.deformation.residuals import shifts, turns
from hoigs.testing.deformation.subject import (
    CHECKS,
    INSIDE,
    RAW,
    DeformationSubject,
    by_name,
    has_parameters,
    require_same,
)
from hoigs.testing.modules import perturb, require_finite_gradients, unchanged, weighed


@CHECKS.check("D19")
def inputs_stay_as_they_were(subject: DeformationSubject) -> None:
    """Rest Gaussians, poses and residuals are not written to."""
    entity = subject.entity()
    moment = subject.at(entity, 0.4)
    parts = {"means": shifts(entity), "pose": turns(entity)}
    asked = {name: x for name, x in parts.items() if name in entity.deformation.residuals}
    inputs: dict[str, Tensor] = {f"rest.{n}": x for n, x in by_name(entity.rest).items()}
    inputs |= {f"residual.{name}": x for name, x in asked.items()}
    for name, pose in moment.poses.items():
        fields = {n: x for n, x in vars(pose).items() if isinstance(x, Tensor)}
        inputs |= {f"moment.poses[{name!r}].{n}": x for n, x in fields.items()}
    with unchanged("", inputs), torch.no_grad():
        entity.deformation(entity.rest, moment, Residual(**asked))
    with unchanged("", inputs):
        weighed(by_name(entity.deformation(entity.rest, moment, Residual(**asked)))).backward()


@CHECKS.check("D24")
def penalties_are_numbers(subject: DeformationSubject) -> None:
    """Regularizers are finite scalars with finite gradients, from the start; weights are >= 0."""
    for count, perturbed in ((1, True), (7, False), (7, True)):
        entity = subject.entity(count, perturbed=perturbed).train()
        for time in (0.0, 0.4):
            subject.draw(entity, time)
            for name, value in entity.regularizers().items():
                require(value.dim() == 0, f'penalty "{name}" has shape {list(value.shape)}')
                require_finite(f'penalty "{name}"', value)
            subject.draw(entity, time)
            penalties = entity.regularizers()
            if penalties:
                require_finite_gradients(entity, weighed(penalties))
    for name, weight in subject.cls.regularizer_weights.items():
        require(weight >= 0, f'the weight of penalty "{name}" is {weight}')


@CHECKS.check("D26")
def every_stage_of_training_has_numbers(subject: DeformationSubject) -> None:
    """In training mode, at the start, in the middle and at the end, all is finite."""
    entity = subject.entity(perturbed=False).train()
    for progress in (0.0, 0.1, 0.5, 0.9, 1.0):
        entity.deformation.set_progress(progress)
        for time in INSIDE:
            output = subject.draw(entity, time)
            for name in RAW:
                require_finite(f"{name} at {time}, {progress:.0%} done", getattr(output, name))
            require_finite_gradients(entity, weighed(by_name(output)))


@CHECKS.check("D31")
def rates_are_those_of_a_spec(subject: DeformationSubject) -> None:
    """Learning rates are asked for by names that a spec's train.rates has."""
    known = set(RatesSpec.model_fields)
    for prefix, rate in subject.cls.rates.items():
        require(rate in known, f'rates["{prefix}"] is "{rate}"; train.rates has {sorted(known)}')


@CHECKS.check("D33", has_parameters)
@torch.no_grad()
def changed_parameters_are_seen(subject: DeformationSubject) -> None:
    """After an optimizer's step, nothing that was kept from before is drawn."""
    used, fresh = subject.entity(), subject.entity()
    subject.draw(used, 0.4)
    for entity in (used, fresh):
        entity.train()
        perturb(entity, seed=6)
        entity.eval()
    require_same("after a step", subject.draw(used, 0.4), subject.draw(fresh, 0.4), atol=1e-6)


@CHECKS.check("D34")
def gradients_change_no_values(subject: DeformationSubject) -> None:
    """Without gradients it is the same as with them."""
    entity = subject.entity()
    for time in INSIDE:
        wanted = subject.draw(entity, time)
        with torch.no_grad():
            got = subject.draw(entity, time)
        require_same(f"without gradients, at {time}", got, wanted, atol=1e-6)
