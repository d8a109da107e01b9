"""D01 to D06: settings, shapes, dtypes, rows, moments and finite values."""

from __future__ import annotations

import json

import torch

from hoigs.testing.compare import require, require_finite
from hoigs.testing.deformation.subject import (
    CHECKS,
    INSIDE,
    OUTSIDE,
    RAW,
    DeformationSubject,
    apply,
    by_name,
    changed_by,
    require_same,
)
from hoigs.testing.modules import require_finite_gradients, weighted_sum


@CHECKS.check("D01")
def settings_are_kept_and_survive_json(subject: DeformationSubject) -> None:
    """Building does not change the settings, and their JSON builds the same model."""
    before = subject.config.model_dump_json()
    first = subject.draw(subject.entity(), 0.5)
    after = subject.config.model_dump_json()
    require(after == before, f"from_config changed its settings from {before} to {after}")
    again = type(subject.config).model_validate(json.loads(before))
    require_same("built from JSON", subject.draw(subject.entity(config=again), 0.5), first)


@CHECKS.check("D02")
def shapes_for_any_number(subject: DeformationSubject) -> None:
    """0, 1 and 7 Gaussians give as many, with every field in its shape."""
    for count in (0, 1, 7):
        entity = subject.entity(count)
        output = subject.draw(entity, 0.4)
        for name, x in by_name(output).items():
            expected = getattr(entity.canonical, name).shape
            require(
                x.shape == expected,
                f"with {count} Gaussians, {name} is {list(x.shape)}, expected {list(expected)}",
            )


@CHECKS.check("D03")
def dtype_and_device_are_kept(subject: DeformationSubject) -> None:
    """The output has dtype and device of the Gaussians, in float32 and in float64."""
    for dtype in (torch.float32, torch.float64):
        entity = subject.entity(dtype=dtype)
        for name, x in by_name(subject.draw(entity, 0.4)).items():
            require(x.dtype == dtype, f"{name} is {x.dtype} where the Gaussians are {dtype}")
            require(
                x.device == entity.means.device,
                f"{name} is on {x.device} where the Gaussians are on {entity.means.device}",
            )


@CHECKS.check("D04")
def order_of_rows_does_not_matter(subject: DeformationSubject) -> None:
    """Permuted rows, with their parameters, give permuted outputs."""
    order = [3, 0, 6, 2, 5, 1, 4]
    plain, permuted = subject.entity(), subject.entity()
    apply(permuted, changed_by(order))
    for time in INSIDE:
        expected = subject.draw(plain, time)[order]
        require_same(f"permuted, at {time}", subject.draw(permuted, time), expected)


@CHECKS.check("D05")
@torch.no_grad()
def moments_are_independent(subject: DeformationSubject) -> None:
    """Several moments in any order give the same as each alone."""
    together = subject.entity()
    order = (0.0, 0.77, 0.13, 1.3, 0.77, 0.0)
    drawn = [(time, subject.draw(together, time).clone()) for time in order]
    for chosen in sorted(set(order)):
        alone = subject.draw(subject.entity(), chosen)
        for time, got in drawn:
            if time == chosen:
                require_same(f"at {time}, among other moments", got, alone, atol=1e-6)


@CHECKS.check("D06")
def values_are_finite(subject: DeformationSubject) -> None:
    """Values and gradients are finite inside the clip, at its ends and outside, also untrained."""
    for perturbed in (False, True):
        entity = subject.entity(perturbed=perturbed)
        for time in (*INSIDE, *OUTSIDE):
            output = subject.draw(entity, time)
            for name in RAW:
                require_finite(f"{name} at {time}", getattr(output, name))
            require_finite_gradients(entity, weighted_sum(by_name(output)))
