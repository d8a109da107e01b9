"""Verdicts of a study as a table, from which matrix, curves and files are made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import mean, stdev
from typing import Any

from hoigs.studies.plotting.style import short_number
from hoigs.studies.stress.case import Case, load_cases
from hoigs.studies.stress.measures import MEASURES
from hoigs.studies.stress.verdict import Verdict, middle_of


@dataclass(frozen=True)
class Spread:
    """Numbers of several seeds at one value of a sweep; std is None with one seed."""

    value: float
    mean: float
    std: float | None
    seeds: int


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

    def curve(self, case: Case, spec: str) -> list[Spread]:
        """The drawn measure at every value that has been run."""
        sweep = case.sweep
        assert sweep is not None
        points = []
        for value in sweep.values:
            numbers = middle_of(self.at(case, spec).seeds, value, sweep.drawn)
            if numbers:
                std = stdev(numbers) if len(numbers) > 1 else None
                points.append(Spread(value, mean(numbers), std, len(numbers)))
        return points

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
    if case.sweep is None:
        return "pass" if verdict.status == "pass" else "fails"
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
    if case.sweep is None:
        return case.criterion
    return f"{case.sweep.required_value:g} ({case.sweep.unit}): {measures_of(case)}"


def measures_of(case: Case) -> str:
    assert case.sweep is not None
    return "; ".join(criterion.words for criterion in case.sweep.criteria)


def axis_title(case: Case) -> str:
    assert case.sweep is not None
    measure = MEASURES[case.sweep.drawn]
    return f"{measure.title} ({measure.unit})" if measure.unit else measure.title
