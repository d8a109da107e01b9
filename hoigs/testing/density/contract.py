"""N08 to N13: seeds, state, inputs, noise, penalties and declared gradients."""

from __future__ import annotations

import random

import torch
from torch import Tensor

from hoigs.core.interfaces.density import Refinement
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
    """Every tensor of a decision."""
    if decision is None:
        return {}
    parts = {"change": decision.change, "canonical": decision.canonical}
    return {
        f"{part}.{name}": x
        for part, value in parts.items()
        if value is not None
        for name, x in vars(value).items()
        if isinstance(x, Tensor)
    }


def require_same(what: str, one: dict[str, Tensor], two: dict[str, Tensor]) -> None:
    same = set(one) == set(two) and all(torch.equal(x, two[name]) for name, x in one.items())
    require(same, f"{what}, the decision differs")


@CHECKS.check("N08", changes_rows)
def same_seed_same_decision(subject: DensitySubject) -> None:
    """A second instance decides the same, whatever torch's and Python's random state."""
    canonical = subject.cloud()
    found = subject.first(subject.control(), canonical)
    assert found is not None
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(99)
        random.random()
        again = subject.refine(subject.control(), found[0], canonical)
    require_same("in a second instance", tensors(found[1]), tensors(again))


@CHECKS.check("N09", changes_rows)
def no_state_between_steps(subject: DensitySubject) -> None:
    """Earlier steps do not change a decision, so that a resumed run is the same."""
    canonical, control = subject.cloud(), subject.control()
    found = subject.first(control, canonical)
    assert found is not None
    other, seen = subject.cloud(seed=1), subject.statistics(seed=1)
    for step in range(1, found[0] + 1):
        subject.refine(control, step, other, seen)
    again = subject.refine(control, found[0], canonical)
    require_same("after other steps", tensors(found[1]), tensors(again))


@CHECKS.check("N10")
def inputs_are_not_modified(subject: DensitySubject) -> None:
    """Gaussians and statistics are not written to."""
    control, canonical, seen = subject.control(), subject.cloud(), subject.statistics()
    inputs = {f"canonical.{n}": x for n, x in vars(canonical).items()}
    inputs |= {f"statistics.{n}": x for n, x in vars(seen).items()}
    with unchanged("", inputs):
        for step in range(1, TOTAL + 1):
            subject.refine(control, step, canonical, seen)
        control.perturb(canonical, step=7, total_steps=TOTAL, rate=1e-3)


@CHECKS.check("N11", perturbs)
def offsets_depend_on_the_step_only(subject: DensitySubject) -> None:
    """Offsets are finite, one for each Gaussian, the same when repeated, and zero at rate 0."""
    canonical = subject.cloud()

    def offsets_at(step: int, rate: float) -> Tensor | None:
        return subject.control().perturb(canonical, step=step, total_steps=TOTAL, rate=rate)

    offsets, again, frozen = offsets_at(7, 1e-3), offsets_at(7, 1e-3), offsets_at(7, 0.0)
    assert offsets is not None
    require(offsets.shape == (COUNT, 3), f"offsets have shape {list(offsets.shape)}")
    require_finite("offsets", offsets)
    require(again is not None and torch.equal(offsets, again), "repeated, the offsets differ")
    require_zero("offsets while positions are frozen", frozen)


@CHECKS.check("N12")
def penalties_are_finite(subject: DensitySubject) -> None:
    """Penalties are finite scalars for many, one and no Gaussians; weights are >= 0."""
    control = subject.control()
    for count in (0, 1, COUNT):
        for name, value in control.regularizers(subject.cloud(count)).items():
            require(value.dim() == 0, f'penalty "{name}" has shape {list(value.shape)}')
            require_finite(f'penalty "{name}" of {count}', value)
    for name, weight in control.regularizer_weights.items():
        require(weight >= 0, f'the weight of penalty "{name}" is {weight}')


@CHECKS.check("N13", changes_rows)
def absolute_gradients_are_declared(subject: DensitySubject) -> None:
    """Without `absolute_gradients` declared, they do not change a decision."""
    if subject.control().absolute_gradients:
        return
    control, canonical, seen = subject.control(), subject.cloud(), subject.statistics()
    found = subject.first(control, canonical)
    assert found is not None
    seen.absolute_sum = torch.zeros_like(seen.absolute_sum)
    again = subject.refine(control, found[0], canonical, seen)
    require_same("without absolute gradients, undeclared", tensors(found[1]), tensors(again))
