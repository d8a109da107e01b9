"""N08 to N13: memory, seeds, inputs, noise, penalties and what it looks at."""

from __future__ import annotations

import random

import torch
from torch import Tensor

from hoigs.core.density import Refinement
from hoigs.testing.compare import require, require_finite, require_zero
from hoigs.testing.density.subject import (
    CHECKS,
    COUNT,
    TOTAL,
    DensitySubject,
    changes_rows,
    perturbs,
)
from hoigs.testing.modules import unchanged


def tensors(decision: Refinement | None) -> dict[str, Tensor]:
    """Everything that a decision holds."""
    if decision is None:
        return {}
    parts = {"change": decision.change, "rest": decision.rest}
    return {
        f"{part}.{name}": x
        for part, value in parts.items()
        if value is not None
        for name, x in vars(value).items()
        if isinstance(x, Tensor)
    }


def require_same(what: str, one: dict[str, Tensor], two: dict[str, Tensor]) -> None:
    same = set(one) == set(two) and all(torch.equal(x, two[name]) for name, x in one.items())
    require(same, f"{what}, the decision is another")


@CHECKS.check("N08", changes_rows)
def same_seed_same_decision(subject: DensitySubject) -> None:
    """One that was built anew decides the same, whatever torch's and Python's random state."""
    rest = subject.cloud()
    found = subject.first(subject.control(), rest)
    assert found is not None
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(99)
        random.random()
        again = subject.refine(subject.control(), found[0], rest)
    require_same("built anew", tensors(found[1]), tensors(again))


@CHECKS.check("N09", changes_rows)
def it_does_not_remember(subject: DensitySubject) -> None:
    """One that has seen other steps decides as one that has not: a resumed run is the same."""
    rest, control = subject.cloud(), subject.control()
    found = subject.first(control, rest)
    assert found is not None
    other, seen = subject.cloud(seed=1), subject.statistics(seed=1)
    for step in range(1, found[0] + 1):
        subject.refine(control, step, other, seen)
    again = subject.refine(control, found[0], rest)
    require_same("after other steps", tensors(found[1]), tensors(again))


@CHECKS.check("N10")
def inputs_stay_as_they_were(subject: DensitySubject) -> None:
    """Gaussians and statistics are not written to."""
    control, rest, seen = subject.control(), subject.cloud(), subject.statistics()
    inputs = {f"rest.{n}": x for n, x in vars(rest).items()}
    inputs |= {f"statistics.{n}": x for n, x in vars(seen).items()}
    with unchanged("", inputs):
        for step in range(1, TOTAL + 1):
            subject.refine(control, step, rest, seen)
        control.perturb(rest, step=7, total_steps=TOTAL, rate=1e-3)


@CHECKS.check("N11", perturbs)
def noise_is_for_this_step_alone(subject: DensitySubject) -> None:
    """Offsets are finite, one a Gaussian, the same when asked again, and none at rate 0."""
    rest = subject.cloud()

    def asked(step: int, rate: float) -> Tensor | None:
        return subject.control().perturb(rest, step=step, total_steps=TOTAL, rate=rate)

    offsets, again, frozen = asked(7, 1e-3), asked(7, 1e-3), asked(7, 0.0)
    assert offsets is not None
    require(offsets.shape == (COUNT, 3), f"offsets have shape {list(offsets.shape)}")
    require_finite("offsets", offsets)
    require(again is not None and torch.equal(offsets, again), "asked again, offsets are others")
    require_zero("offsets while positions are frozen", frozen)


@CHECKS.check("N12")
def penalties_are_numbers(subject: DensitySubject) -> None:
    """Penalties are finite scalars, of a cloud, of one Gaussian and of none; weights are >= 0."""
    control = subject.control()
    for count in (0, 1, COUNT):
        for name, value in control.regularizers(subject.cloud(count)).items():
            require(value.dim() == 0, f'penalty "{name}" has shape {list(value.shape)}')
            require_finite(f'penalty "{name}" of {count}', value)
    for name, weight in control.regularizer_weights.items():
        require(weight >= 0, f'the weight of penalty "{name}" is {weight}')


@CHECKS.check("N13", changes_rows)
def absolute_gradients_are_declared(subject: DensitySubject) -> None:
    """One that does not declare `absolute_gradients` decides the same without them."""
    if subject.control().absolute_gradients:
        return
    control, rest, seen = subject.control(), subject.cloud(), subject.statistics()
    found = subject.first(control, rest)
    assert found is not None
    seen.absolute_sum = torch.zeros_like(seen.absolute_sum)
    again = subject.refine(control, found[0], rest, seen)
    require_same("without absolute gradients, undeclared", tensors(found[1]), tensors(again))
