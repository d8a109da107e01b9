"""Verdicts: what each seed stood, and what that says of a case and a spec; plain data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from hoigs.evaluation.protocol import NotComputed, Value
from hoigs.studies.stress.case import Case, Criterion, Knob

Status = Literal["pass", "fail", "nature", "not applicable", "not run"]

MEANING: Mapping[Status, str] = {
    "pass": "stands what the case asks for",
    "fail": "does not",
    "nature": "does not, as its method is; see the advice",
    "not applicable": "the model has nothing of the kind",
    "not run": "no verdict yet",
}


@dataclass(frozen=True)
class Level:
    """One value of a knob, of one seed.

    Attributes:
        stands: whether all criteria hold.
        why: which do not, or why there are no numbers.
        values: by measure. run: folder, relative to the study's.
    """

    value: float
    stands: bool
    why: str = ""
    values: Mapping[str, Value] = field(default_factory=dict)
    run: str = ""


@dataclass(frozen=True)
class Seed:
    """What one seed stood, easiest value first.

    Attributes:
        broke_at: first value that it did not stand; None where it stood all that it was given.
    """

    seed: int
    levels: tuple[Level, ...]

    @property
    def broke_at(self) -> float | None:
        return next((level.value for level in self.levels if not level.stands), None)

    def stands(self, value: float) -> bool | None:
        """Whether it stood a value; what broke at an easier one does not. None: not known."""
        for level in self.levels:
            if not level.stands:
                return False
            if level.value == value:
                return True
        return None


@dataclass(frozen=True)
class Verdict:
    """One case and one spec.

    Attributes:
        case, spec: id and label. status: see MEANING.
        measured: of a direct check, or why there is no verdict.
        rate: share of the seeds that stand what is asked for, of those that are known.
        seeds: of a knob.
        breaks_at: the value that half of the seeds or more do not stand; None is beyond the last,
            or not known.
        machines, protocol: how the numbers came about.
        ours: whether a check of our own code decided, before any training.
    """

    case: str
    spec: str
    status: Status
    measured: str = ""
    rate: float | None = None
    seeds: tuple[Seed, ...] = ()
    breaks_at: float | None = None
    machines: tuple[str, ...] = ()
    protocol: tuple[str, ...] = ()
    ours: bool = False

    def to_dict(self) -> dict[str, Any]:
        data = asdict(self)
        for seed, plain in zip(self.seeds, data["seeds"], strict=True):
            plain["broke_at"] = seed.broke_at
            for level, shown in zip(seed.levels, plain["levels"], strict=True):
                shown["values"] = {
                    name: {"not_computed": v.reason} if isinstance(v, NotComputed) else v
                    for name, v in level.values.items()
                }
        return data


def judge(
    knob: Knob, value: float, found: Mapping[str, Value], first: Mapping[str, Value], run: str
) -> Level:
    """One value of one seed, against the criteria.

    Args:
        found: its measures. first: those at the first value.
    """
    broken = [why for c in knob.criteria if (why := _broken(c, found, first)) is not None]
    return Level(value, not broken, "; ".join(broken), found, run)


def _broken(
    criterion: Criterion, found: Mapping[str, Value], first: Mapping[str, Value]
) -> str | None:
    value, start = found[criterion.measure], first[criterion.measure]
    for number in (value, start):
        if isinstance(number, NotComputed):
            return f"{criterion.words}: {number.reason}"
    assert not isinstance(value, NotComputed) and not isinstance(start, NotComputed)
    if criterion.holds(value, start):
        return None
    return f"{criterion.words}: {value:.4g} of {start:.4g}"


def verdict_of(case: Case, spec: str, nature: bool, seeds: Sequence[Seed], **more: Any) -> Verdict:
    """What the seeds say together: pass if most of them stand what is asked for.

    Args:
        nature: whether failing is what this spec's method does.
    """
    knob = case.knob
    assert knob is not None
    known = [s for seed in seeds if (s := seed.stands(knob.must_stand)) is not None]
    rate = sum(known) / len(known) if known else None
    status: Status = "not run"
    if rate is not None and len(known) == len(seeds):
        status = "pass" if rate > 0.5 else "nature" if nature else "fail"
    return Verdict(
        case.id, spec, status, in_words(seeds), rate, tuple(seeds), breaking(knob, seeds), **more
    )


def in_words(seeds: Sequence[Seed]) -> str:
    """Why seeds broke: each reason once, with the numbers and values of all that it has."""
    found: dict[str, list[str]] = {}
    for seed in seeds:
        for level in seed.levels:
            for why in filter(None, level.why.split("; ")):
                words, _, numbers = why.partition(": ")
                found.setdefault(words, []).append(f"{numbers} (seed {seed.seed}, {level.value:g})")
    return "; ".join(f"{words}: {', '.join(numbers)}" for words, numbers in found.items())


def breaking(knob: Knob, seeds: Sequence[Seed]) -> float | None:
    """The first value that half of the seeds or more do not stand."""
    for value in knob.values:
        known = [s for seed in seeds if (s := seed.stands(value)) is not None]
        if known and len(known) == len(seeds) and sum(known) <= 0.5 * len(known):
            return value
    return None


def middle_of(seeds: Sequence[Seed], value: float, measure: str) -> list[float]:
    """The numbers of all seeds that have one at a value."""
    found = []
    for seed in seeds:
        for level in seed.levels:
            number = level.values.get(measure)
            if level.value == value and isinstance(number, float):
                found.append(number)
    return found
