"""N01 to N07: what a decision is: rows, offsets, numbers, and the cap."""

from __future__ import annotations

import torch

from hoigs.core.density import DensityStatistics, Refinement
from hoigs.core.gaussians import Gaussians
from hoigs.testing.compare import require, require_close, require_finite
from hoigs.testing.density.subject import CHECKS, TOTAL, DensitySubject, caps, changes_rows

RAW = ("means", "quats", "log_scales", "opacity_logits", "sh")


def changed(subject: DensitySubject, rest: Gaussians) -> Refinement:
    """The first decision that changes rows; `changes_rows` has seen that there is one."""
    found = subject.first(subject.control(), rest)
    assert found is not None
    return found[1]


@CHECKS.check("N01", changes_rows)
def a_decision_is_an_index_map(subject: DensitySubject) -> None:
    """The index map names old rows, and comes with as many new rest Gaussians."""
    rest = subject.cloud()
    decision = changed(subject, rest)
    change, new = decision.change, decision.rest
    assert change is not None
    require(new is not None, "a change of rows comes without rest Gaussians")
    assert new is not None
    require(len(new) == len(change), f"{len(change)} rows, but {len(new)} rest Gaussians")
    inside = bool(((change.source >= 0) & (change.source < len(rest))).all())
    require(inside, f"source names rows beyond the {len(rest)} that there were")
    for name in ("fresh", "offsets", "copies"):
        value = getattr(change, name)
        same = value is None or len(value) == len(change)
        require(same, f"{name} does not have {len(change)} rows")
    require(change.fresh.dtype == torch.bool, f"fresh is {change.fresh.dtype}, expected bool")


@CHECKS.check("N02", caps)
def the_cap_is_held(subject: DensitySubject) -> str:
    """From just below the cap, and from few, there are never more Gaussians than the cap."""
    control = subject.control()
    assert control.cap is not None
    most = 0
    for count in (max(1, control.cap - 5), min(200, control.cap)):
        rest = subject.cloud(count)
        asking = subject.statistics(count)
        for step in range(1, TOTAL + 1):
            decision = subject.refine(control, step, rest, asking)
            if decision is not None and decision.rest is not None:
                rest = decision.rest
                asking = subject.statistics(len(rest), seed=step)
                most = max(most, len(rest))
                require(most <= control.cap, f"{most} Gaussians at step {step}, cap {control.cap}")
    return f"at most {most} of {control.cap}"


@CHECKS.check("N03", changes_rows)
def rows_that_stay_stay_as_they_were(subject: DensitySubject) -> None:
    """Rows that are neither fresh nor shared keep every rest value, bit for bit."""
    rest = subject.cloud()
    decision = changed(subject, rest)
    change, new = decision.change, decision.rest
    assert change is not None and new is not None
    kept = ~change.fresh
    if change.copies is not None:
        kept &= change.copies == 1
    before = rest[change.source]
    for name in RAW:
        same = torch.equal(getattr(new, name)[kept], getattr(before, name)[kept])
        require(same, f"{name} of rows that stay was changed, without their being fresh")


@CHECKS.check("N04", changes_rows)
def offsets_are_how_far_rows_moved(subject: DensitySubject) -> None:
    """`offsets` is the new rest centre less that of its source, for every row."""
    rest = subject.cloud()
    decision = changed(subject, rest)
    change, new = decision.change, decision.rest
    assert change is not None and new is not None
    moved = new.means - rest.means[change.source]
    require_close("offsets", change.offsets, moved, atol=1e-6, rtol=1e-5)


@CHECKS.check("N05")
def numbers_whatever_was_seen(subject: DensitySubject) -> None:
    """New values are finite for usual clouds, one Gaussian, and all transparent ones."""
    clear = subject.cloud().replace(opacity_logits=torch.full((60,), -20.0).to(subject.device))
    unseen = DensityStatistics.zeros(60, subject.device)
    cases = [(subject.cloud(), None), (subject.cloud(1), None), (clear, None), (clear, unseen)]
    for rest, statistics in cases:
        control = subject.control()
        seen = statistics or subject.statistics(len(rest))
        for step in range(1, TOTAL + 1):
            decision = subject.refine(control, step, rest, seen)
            if decision is not None and decision.rest is not None:
                for name in RAW:
                    require_finite(f"{name} of the new rest", getattr(decision.rest, name))
                break


@CHECKS.check("N06")
def no_gaussians_are_no_error(subject: DensitySubject) -> None:
    """An entity without Gaussians is left as it is."""
    control = subject.control()
    nobody = subject.cloud(0)
    for step in range(0, TOTAL + 1, 50):
        decision = subject.refine(control, step, nobody, DensityStatistics.zeros(0, subject.device))
        grown = decision is not None and decision.rest is not None and len(decision.rest) > 0
        require(not grown, "it makes Gaussians of none")
        control.perturb(nobody, step=step, total_steps=TOTAL, rate=1e-3)


@CHECKS.check("N07")
def resets_are_opacities(subject: DensitySubject) -> None:
    """A ceiling for opacities is between 0 and 1."""
    control, rest, seen = subject.control(), subject.cloud(), subject.statistics()
    for step in range(1, TOTAL + 1):
        decision = subject.refine(control, step, rest, seen)
        if decision is not None and decision.reset_opacity is not None:
            ceiling = decision.reset_opacity
            require(0 < ceiling < 1, f"reset_opacity is {ceiling} at step {step}")
