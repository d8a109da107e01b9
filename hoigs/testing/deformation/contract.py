"""D19, D24, D26, D31, D33 and D34: inputs, penalties, progress, learning rates and caches."""

from __future__ import annotations

import torch
from torch import Tensor

from hoigs.core.spec.train_schema import RatesSpec
from hoigs.core.values.tokens import Residual
from hoigs.testing.compare import require, require_finite
from hoigs.testing.deformation.residuals import mean_residual, pose_residual
from hoigs.testing.deformation.subject import (
    CHECKS,
    INSIDE,
    RAW,
    DeformationSubject,
    by_name,
    has_parameters,
    require_same,
)
from hoigs.testing.modules import perturb, require_finite_gradients, unchanged, weighted_sum


@CHECKS.check("D19")
def inputs_are_not_modified(subject: DeformationSubject) -> None:
    """Canonical Gaussians, poses and residuals are not written to."""
    entity = subject.entity()
    moment = subject.at(entity, 0.4)
    parts = {"means": mean_residual(entity), "pose": pose_residual(entity)}
    residual = {name: x for name, x in parts.items() if name in entity.deformation.residuals}
    inputs: dict[str, Tensor] = {f"canonical.{n}": x for n, x in by_name(entity.canonical).items()}
    inputs |= {f"residual.{name}": x for name, x in residual.items()}
    for name, pose in moment.poses.items():
        fields = {n: x for n, x in vars(pose).items() if isinstance(x, Tensor)}
        inputs |= {f"moment.poses[{name!r}].{n}": x for n, x in fields.items()}
    with unchanged("", inputs), torch.no_grad():
        entity.deformation(entity.canonical, moment, Residual(**residual))
    with unchanged("", inputs):
        weighted_sum(
            by_name(entity.deformation(entity.canonical, moment, Residual(**residual)))
        ).backward()


@CHECKS.check("D24")
def penalties_are_finite(subject: DeformationSubject) -> None:
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
                require_finite_gradients(entity, weighted_sum(penalties))
    for name, weight in subject.cls.regularizer_weights.items():
        require(weight >= 0, f'the weight of penalty "{name}" is {weight}')


@CHECKS.check("D26")
def values_are_finite_at_every_stage(subject: DeformationSubject) -> None:
    """In training mode, values and gradients are finite at every progress."""
    entity = subject.entity(perturbed=False).train()
    for progress in (0.0, 0.1, 0.5, 0.9, 1.0):
        entity.deformation.set_progress(progress)
        for time in INSIDE:
            output = subject.draw(entity, time)
            for name in RAW:
                require_finite(f"{name} at {time}, {progress:.0%} done", getattr(output, name))
            require_finite_gradients(entity, weighted_sum(by_name(output)))


@CHECKS.check("D31")
def rates_exist_in_the_spec(subject: DeformationSubject) -> None:
    """Learning rates have names that a spec's train.rates has."""
    known = set(RatesSpec.model_fields)
    for prefix, rate in subject.cls.rates.items():
        require(rate in known, f'rates["{prefix}"] is "{rate}"; train.rates has {sorted(known)}')


@CHECKS.check("D33", has_parameters)
@torch.no_grad()
def no_stale_caches(subject: DeformationSubject) -> None:
    """After an optimizer step, the output has no values from before it."""
    used, fresh = subject.entity(), subject.entity()
    subject.draw(used, 0.4)
    for entity in (used, fresh):
        entity.train()
        perturb(entity, seed=6)
        entity.eval()
    require_same("after a step", subject.draw(used, 0.4), subject.draw(fresh, 0.4), atol=1e-6)


@CHECKS.check("D34")
def values_do_not_depend_on_grad_mode(subject: DeformationSubject) -> None:
    """Values are the same without gradients."""
    entity = subject.entity()
    for time in INSIDE:
        expected = subject.draw(entity, time)
        with torch.no_grad():
            got = subject.draw(entity, time)
        require_same(f"without gradients, at {time}", got, expected, atol=1e-6)
