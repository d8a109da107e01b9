"""N01 to N07: rows, offsets, values and the cap of a decision."""

from __future__ import annotations

import torch

from hoigs.core.interfaces.density import DensityStatistics, Refinement
from hoigs.core.values.gaussians import Gaussians
from hoigs.testing.compare import require, require_close, require_finite
from hoigs.testing.density.subject import CHECKS, TOTAL, DensitySubject, caps, changes_rows

RAW = ("means", "quats", "log_scales", "opacity_logits", "sh")


def changed(subject: DensitySubject, canonical: Gaussians) -> Refinement:
    """The first decision that changes rows, which `changes_rows` has found to exist."""
    found = subject.first(subject.control(), canonical)
    assert found is not None
    return found[1]


@CHECKS.check("N01", changes_rows)
def a_decision_is_an_index_map(subject: DensitySubject) -> None:
    """The index map names old rows, and comes with as many new canonical Gaussians."""
    canonical = subject.cloud()
    decision = changed(subject, canonical)
    change, new = decision.change, decision.canonical
    assert change is not None
    require(new is not None, "a change of rows comes without canonical Gaussians")
    assert new is not None
    require(len(new) == len(change), f"{len(change)} rows, but {len(new)} canonical Gaussians")
    inside = bool(((change.source >= 0) & (change.source < len(canonical))).all())
    require(inside, f"source has rows beyond the {len(canonical)} old ones")
    for name in ("fresh", "offsets", "copies"):
        value = getattr(change, name)
        same = value is None or len(value) == len(change)
        require(same, f"{name} does not have {len(change)} rows")
    require(change.fresh.dtype == torch.bool, f"fresh is {change.fresh.dtype}, expected bool")


@CHECKS.check("N02", caps)
def the_cap_is_kept(subject: DensitySubject) -> str:
    """The count never exceeds the cap, from few Gaussians and from just below the cap."""
    control = subject.control()
    assert control.cap is not None
    most = 0
    for count in (max(1, control.cap - 5), min(200, control.cap)):
        canonical = subject.cloud(count)
        statistics = subject.statistics(count)
        for step in range(1, TOTAL + 1):
            decision = subject.refine(control, step, canonical, statistics)
            if decision is not None and decision.canonical is not None:
                canonical = decision.canonical
                statistics = subject.statistics(len(canonical), seed=step)
                most = max(most, len(canonical))
                require(most <= control.cap, f"{most} Gaussians at step {step}, cap {control.cap}")
    return f"at most {most} of {control.cap}"


@CHECKS.check("N03", changes_rows)
def other_rows_keep_their_values(subject: DensitySubject) -> None:
    """Rows that are neither fresh nor shared keep every canonical value, bit for bit."""
    canonical = subject.cloud()
    decision = changed(subject, canonical)
    change, new = decision.change, decision.canonical
    assert change is not None and new is not None
    kept = ~change.fresh
    if change.copies is not None:
        kept &= change.copies == 1
    before = canonical[change.source]
    for name in RAW:
        same = torch.equal(getattr(new, name)[kept], getattr(before, name)[kept])
        require(same, f"{name} of rows that are not fresh has changed")


@CHECKS.check("N04", changes_rows)
def offsets_are_displacements(subject: DensitySubject) -> None:
    """`offsets` is the new canonical mean minus that of its source, for every row."""
    canonical = subject.cloud()
    decision = changed(subject, canonical)
    change, new = decision.change, decision.canonical
    assert change is not None and new is not None
    moved = new.means - canonical.means[change.source]
    require_close("offsets", change.offsets, moved, atol=1e-6, rtol=1e-5)


@CHECKS.check("N05")
def values_are_finite(subject: DensitySubject) -> None:
    """New values are finite for many Gaussians, for one, and for transparent ones."""
    clear = subject.cloud().replace(opacity_logits=torch.full((60,), -20.0).to(subject.device))
    unseen = DensityStatistics.zeros(60, subject.device)
    cases = [(subject.cloud(), None), (subject.cloud(1), None), (clear, None), (clear, unseen)]
    for canonical, statistics in cases:
        control = subject.control()
        seen = statistics or subject.statistics(len(canonical))
        for step in range(1, TOTAL + 1):
            decision = subject.refine(control, step, canonical, seen)
            if decision is not None and decision.canonical is not None:
                for name in RAW:
                    require_finite(
                        f"{name} of the new canonical Gaussians", getattr(decision.canonical, name)
                    )
                break


@CHECKS.check("N06")
def no_gaussians_are_accepted(subject: DensitySubject) -> None:
    """An entity without Gaussians stays empty."""
    control = subject.control()
    empty = subject.cloud(0)
    for step in range(0, TOTAL + 1, 50):
        decision = subject.refine(control, step, empty, DensityStatistics.zeros(0, subject.device))
        grown = (
            decision is not None and decision.canonical is not None and len(decision.canonical) > 0
        )
        require(not grown, "it adds Gaussians to an empty entity")
        control.perturb(empty, step=step, total_steps=TOTAL, rate=1e-3)


@CHECKS.check("N07")
def opacity_resets_are_valid(subject: DensitySubject) -> None:
    """The bound of an opacity reset is between 0 and 1."""
    control, canonical, seen = subject.control(), subject.cloud(), subject.statistics()
    for step in range(1, TOTAL + 1):
        decision = subject.refine(control, step, canonical, seen)
        if decision is not None and decision.reset_opacity is not None:
            ceiling = decision.reset_opacity
            require(0 < ceiling < 1, f"reset_opacity is {ceiling} at step {step}")
