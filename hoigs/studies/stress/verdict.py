"""Verdicts of cases and specs, from the levels that each seed passed; plain data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from hoigs.evaluation.protocol import NotComputed, Value, to_json
from hoigs.studies.jobs.results import Spread
from hoigs.studies.plots import short_number
from hoigs.studies.stress.case import Case, Criterion, Sweep, load_cases
from hoigs.studies.stress.measures import MEASURES

Status = Literal["pass", "fail", "limitation", "not applicable", "not run"]
MEANING: Mapping[Status, str] = {
    "pass": "passes what the case requires",
    "fail": "does not pass what the case requires",
    "limitation": "fails, as expected of the method; see the advice",
    "not applicable": "the model lacks what the case is about",
    "not run": "no verdict yet",
}


@dataclass(frozen=True)
class Level:
    """One value of a sweep, of one seed.

    Attributes:
        stands: whether all criteria hold.
        why: criteria that do not, or why there are no numbers.
        values: by measure. run: folder, relative to the study's.
    """

    value: float
    stands: bool
    why: str = ""
    values: Mapping[str, Value] = field(default_factory=dict)
    run: str = ""


@dataclass(frozen=True)
class Seed:
    """Levels of one seed, easiest value first.

    Attributes:
        broke_at: first value that failed; None where all that were run passed.
    """

    seed: int
    levels: tuple[Level, ...]

    @property
    def broke_at(self) -> float | None:
        return next((level.value for level in self.levels if not level.stands), None)

    def stands(self, value: float) -> bool | None:
        """Whether it passes a value: not if it failed an easier one. None: not known."""
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
        measured: which criteria failed, or why there is no verdict.
        rate: share of the seeds that pass the required value, of those that are known.
        seeds: of a sweep.
        breaks_at: the first value that half of the seeds or more fail; None is beyond the last, or
            not known.
        machines, protocol: how the numbers were measured.
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

    def to_dict(self) -> dict[str, Any]:
        data = asdict(self)
        for seed, plain in zip(self.seeds, data["seeds"], strict=True):
            plain["broke_at"] = seed.broke_at
            for level, shown in zip(seed.levels, plain["levels"], strict=True):
                shown["values"] = {name: to_json(v) for name, v in level.values.items()}
        return data


def level_of(
    sweep: Sweep, value: float, found: Mapping[str, Value], first: Mapping[str, Value], run: str
) -> Level:
    """The level of one value and seed, by the criteria of a sweep.

    Args:
        found: its measures. first: those at the first value.
    """
    broken = [why for c in sweep.criteria if (why := _broken(c, found, first)) is not None]
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


def verdict_of(
    case: Case, spec: str, limitation: bool, seeds: Sequence[Seed], **more: Any
) -> Verdict:
    """Verdict over seeds: pass if most of them pass the required value.

    Args:
        limitation: whether failing is inherent in the method.
    """
    sweep = case.sweep
    known = [s for seed in seeds if (s := seed.stands(sweep.required_value)) is not None]
    rate = sum(known) / len(known) if known else None
    status: Status = "not run"
    if rate is not None and len(known) == len(seeds):
        status = "pass" if rate > 0.5 else "limitation" if limitation else "fail"
    return Verdict(
        case.id, spec, status, in_words(seeds), rate, tuple(seeds), breaking(sweep, seeds), **more
    )


def in_words(seeds: Sequence[Seed]) -> str:
    """Why seeds failed: each reason once, with its numbers and values."""
    found: dict[str, list[str]] = {}
    for seed in seeds:
        for level in seed.levels:
            for why in filter(None, level.why.split("; ")):
                words, _, numbers = why.partition(": ")
                found.setdefault(words, []).append(f"{numbers} (seed {seed.seed}, {level.value:g})")
    return "; ".join(f"{words}: {', '.join(numbers)}" for words, numbers in found.items())


def breaking(sweep: Sweep, seeds: Sequence[Seed]) -> float | None:
    """The first value that half of the seeds or more fail."""
    for value in sweep.values:
        known = [s for seed in seeds if (s := seed.stands(value)) is not None]
        if known and len(known) == len(seeds) and sum(known) <= 0.5 * len(known):
            return value
    return None


def middle_of(seeds: Sequence[Seed], value: float, measure: str) -> list[float]:
    """The numbers of all seeds that have one at a value."""
    levels = [level for seed in seeds for level in seed.levels if level.value == value]
    numbers = [level.values.get(measure) for level in levels]
    return [number for number in numbers if isinstance(number, float)]


# Verdicts of a study as a table, from which matrix, curves and files are made.


@dataclass(frozen=True)
class Table:
    """Cases down, specs across.

    Attributes:
        verdicts: by case id and label of the spec. definitions: of each spec, by label.
        about: how the study was made, for every file.
    """

    cases: Sequence[Case]
    definitions: Mapping[str, str]
    verdicts: Mapping[tuple[str, str], Verdict]
    about: Mapping[str, Any]

    @property
    def specs(self) -> list[str]:
        return list(self.definitions)

    def at(self, case: Case, spec: str) -> Verdict:
        return self.verdicts[case.id, spec]

    def families(self) -> dict[str, list[Case]]:
        """The table's cases by family, those without any left out."""
        found = {
            family: [c for c in cases if c in self.cases] for family, cases in load_cases().items()
        }
        return {family: cases for family, cases in found.items() if cases}

    def curve(self, case: Case, spec: str) -> dict[float, Spread]:
        """The drawn measure over seeds at every value that has been run."""
        seeds = self.at(case, spec).seeds
        found = {v: middle_of(seeds, v, case.sweep.drawn) for v in case.sweep.values}
        return {value: Spread.of(numbers) for value, numbers in found.items() if numbers}

    @property
    def machines(self) -> list[str]:
        return list(dict.fromkeys(m for v in self.verdicts.values() for m in v.machines))

    @property
    def notes(self) -> list[str]:
        """Machine, date and settings, in sentences for every file."""
        machines = self.machines
        trained = f"Trained on {' and '.join(machines)}." if machines else "Nothing was trained."
        if len(machines) > 1:
            trained += " Results may differ between these machines."
        return [trained, *(f"{k.capitalize()}: {v}." for k, v in self.about.items())]


def make_table(
    cases: Sequence[Case],
    definitions: Mapping[str, str],
    verdicts: Sequence[Verdict],
    about: Mapping[str, Any],
) -> Table:
    return Table(cases, definitions, {(v.case, v.spec): v for v in verdicts}, about)


def in_short(case: Case, verdict: Verdict) -> str:
    """Short text of a cell: "pass", "breaks at 4"."""
    if verdict.status == "not applicable":
        return "–"
    if verdict.status == "not run":
        return "not run"
    if verdict.breaks_at is None:
        stands = f"stands {short_number(case.sweep.values[-1])}"
    else:
        stands = f"breaks at {short_number(verdict.breaks_at)}"
    return stands if verdict.seeds else "fails"


def rate_of(verdict: Verdict) -> str:
    """ "2/3" of the seeds, where there are any."""
    if verdict.rate is None:
        return ""
    return f"{round(verdict.rate * len(verdict.seeds))}/{len(verdict.seeds)}"


def requirement_of(case: Case) -> str:
    """What a case requires, with the unit of its sweep."""
    return f"{case.sweep.required_value:g} ({case.sweep.unit}): {measures_of(case)}"


def measures_of(case: Case) -> str:
    return "; ".join(criterion.words for criterion in case.sweep.criteria)


def axis_title(case: Case) -> str:
    measure = MEASURES[case.sweep.drawn]
    return f"{measure.title} ({measure.unit})" if measure.unit else measure.title
