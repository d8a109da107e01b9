"""Conformance of density controls: `CHECKS`, on synthetic Gaussians."""

from __future__ import annotations

import random
from typing import Any

import torch
from torch import Tensor

from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.density import DensityControl, DensityStatistics, Refinement
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.topology import TopologyChange
from hoigs.testing.checks import CheckList, require, require_close, require_finite, require_zero
from hoigs.testing.material import OBJECT, tiny_clip
from hoigs.testing.modules import DeviceSubject, require_penalties, unchanged
from hoigs.testing.runner import Options

COUNT = 60
TOTAL = 2000  # steps of the simulated run
EXTENT = 2.0
LARGEST = 150_000  # cap that a check still tests, in Gaussians


class DensitySubject(DeviceSubject[DensityControl]):
    """The component under check."""

    def control(self) -> DensityControl:
        return self.cls.from_config(self.config, BuildContext(OBJECT, tiny_clip()))

    def cloud(self, count: int = COUNT, seed: int = 0) -> Gaussians:
        """Gaussians of all sizes, some of them nearly transparent."""
        generator = torch.Generator().manual_seed(seed)

        def normal(*shape: int) -> Tensor:
            return torch.randn(count, *shape, generator=generator)

        cloud = Gaussians(
            means=normal(3),
            quats=normal(4),
            log_scales=normal(3) - 3.5,
            opacity_logits=3 * normal() - 2,
            sh=0.3 * normal(4, 3),
        )
        return cloud.to(self.device)

    def statistics(self, count: int = COUNT, seed: int = 0) -> DensityStatistics:
        """Statistics of some views: a third is above usual thresholds, some were never visible."""
        generator = torch.Generator().manual_seed(100 + seed)

        def uniform() -> Tensor:
            return torch.rand(count, generator=generator)

        seen = torch.randint(0, 5, (count,), generator=generator).float()
        gradient = 6e-4 * uniform() * (uniform() > 0.3)
        made = DensityStatistics(
            gradient_sum=gradient * seen,
            visible_count=seen,
            max_radius=30 * uniform() * (seen > 0),
            absolute_sum=3 * gradient * seen,
            loss_sum=uniform() * seen,
        )
        return DensityStatistics(*(x.to(self.device) for x in vars(made).values()))

    def refine(
        self,
        control: DensityControl,
        step: int,
        canonical: Gaussians,
        statistics: DensityStatistics | None = None,
    ) -> Refinement | None:
        statistics = statistics or self.statistics(len(canonical))
        return control.refine(
            canonical, canonical, statistics, step=step, total_steps=TOTAL, extent=EXTENT
        )

    def first(self, control: DensityControl, canonical: Gaussians) -> tuple[int, Refinement] | None:
        """The first step that changes rows, and the decision; None when none does."""
        seen = self.statistics(len(canonical))
        for step in range(1, TOTAL + 1):
            found = self.refine(control, step, canonical, seen)
            if found is not None and found.change is not None:
                return step, found
        return None


CHECKS: CheckList[DensitySubject] = CheckList("N")


def subject(cls: type[DensityControl], config: Any, options: Options) -> DensitySubject:
    made = DensitySubject(cls, config, torch.device(options.device))
    made.control()
    return made


def changes_rows(subject: DensitySubject) -> str | None:
    found = subject.first(subject.control(), subject.cloud())
    return None if found else f"it changes no rows in {TOTAL} steps"


def caps(subject: DensitySubject) -> str | None:
    cap = subject.control().cap
    if cap is None:
        return "it declares no cap"
    return None if cap <= LARGEST else f"its cap is {cap}: set a smaller one in the settings"


def perturbs(subject: DensitySubject) -> str | None:
    offsets = subject.control().perturb(subject.cloud(), step=7, total_steps=TOTAL, rate=1e-3)
    return None if offsets is not None else "its `perturb` returns no offsets"


# N01 to N07: rows, offsets, values and the cap of a decision.

RAW = ("means", "quats", "log_scales", "opacity_logits", "sh")


def changed(
    subject: DensitySubject, canonical: Gaussians, control: DensityControl | None = None
) -> tuple[int, Refinement]:
    """The first step that changes rows, which `changes_rows` has found to exist."""
    found = subject.first(control or subject.control(), canonical)
    assert found is not None
    return found


def rows_of(subject: DensitySubject, canonical: Gaussians) -> tuple[TopologyChange, Gaussians]:
    """The index map of that step, and the new canonical Gaussians."""
    decision = changed(subject, canonical)[1]
    assert decision.change is not None
    require(decision.canonical is not None, "a change of rows comes without canonical Gaussians")
    assert decision.canonical is not None
    return decision.change, decision.canonical


@CHECKS.check("N01", changes_rows)
def a_decision_is_an_index_map(subject: DensitySubject) -> None:
    """The index map names old rows, and comes with as many new canonical Gaussians."""
    canonical = subject.cloud()
    change, new = rows_of(subject, canonical)
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
    change, new = rows_of(subject, canonical)
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
    change, new = rows_of(subject, canonical)
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
                    value = getattr(decision.canonical, name)
                    require_finite(f"{name} of the new canonical Gaussians", value)
                break


@CHECKS.check("N06")
def no_gaussians_are_accepted(subject: DensitySubject) -> None:
    """An entity without Gaussians stays empty."""
    control = subject.control()
    empty = subject.cloud(0)
    for step in range(0, TOTAL + 1, 50):
        decision = subject.refine(control, step, empty, DensityStatistics.zeros(0, subject.device))
        new = None if decision is None else decision.canonical
        require(new is None or len(new) == 0, "it adds Gaussians to an empty entity")
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


# N08 to N13: seeds, state, inputs, noise, penalties and declared gradients.


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
    step, decision = changed(subject, canonical)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(99)
        random.random()
        again = subject.refine(subject.control(), step, canonical)
    require_same("in a second instance", tensors(decision), tensors(again))


@CHECKS.check("N09", changes_rows)
def no_state_between_steps(subject: DensitySubject) -> None:
    """Earlier steps do not change a decision, so that a resumed run is the same."""
    canonical, control = subject.cloud(), subject.control()
    step, decision = changed(subject, canonical, control)
    other, seen = subject.cloud(seed=1), subject.statistics(seed=1)
    for earlier in range(1, step + 1):
        subject.refine(control, earlier, other, seen)
    again = subject.refine(control, step, canonical)
    require_same("after other steps", tensors(decision), tensors(again))


@CHECKS.check("N10")
def inputs_are_not_modified(subject: DensitySubject) -> None:
    """Gaussians and statistics are not written to."""
    control, canonical, seen = subject.control(), subject.cloud(), subject.statistics()
    inputs = {f"canonical.{n}": x for n, x in canonical.tensors().items()}
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
        found = control.regularizers(subject.cloud(count))
        require_penalties(found, control.regularizer_weights)


@CHECKS.check("N13", changes_rows)
def absolute_gradients_are_declared(subject: DensitySubject) -> None:
    """Without `absolute_gradients` declared, they do not change a decision."""
    if subject.control().absolute_gradients:
        return
    control, canonical, seen = subject.control(), subject.cloud(), subject.statistics()
    step, decision = changed(subject, canonical, control)
    seen.absolute_sum = torch.zeros_like(seen.absolute_sum)
    again = subject.refine(control, step, canonical, seen)
    require_same("without absolute gradients, undeclared", tensors(decision), tensors(again))
