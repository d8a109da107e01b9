"""Mean and spread over seeds of every measure of the evaluations, by row and clip."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from statistics import mean, stdev
from typing import Any

from hoigs.evaluation.protocol import NotComputed, Value, from_json
from hoigs.studies.jobs.rows import Row, TableSet

Measure = tuple[str, str, str]  # view or "geometry", "time", "size"; region or part; metric
ALL_CLIPS = "mean of all clips"


@dataclass(frozen=True)
class Spread:
    """One number over seeds. std is the sample's (n - 1); None with one seed."""

    mean: float
    std: float | None
    values: tuple[float, ...]

    @staticmethod
    def of(values: Sequence[float]) -> Spread:
        return Spread(mean(values), stdev(values) if len(values) > 1 else None, tuple(values))


@dataclass(frozen=True)
class RowResult:
    """A row on one clip: its measures by seed, or why a seed has none.

    Attributes:
        runs: run folder by seed, relative to the tables' own folder.
    """

    row: Row
    clip: str
    by_seed: Mapping[int, Mapping[Measure, Value]]
    missing: Mapping[int, str]
    runs: Mapping[int, str] = field(default_factory=dict)

    def over_seeds(self, measure: Measure) -> Spread | NotComputed:
        """Mean and spread, or the reasons of the seeds that have no number."""
        if self.missing:
            reasons = sorted(set(self.missing.values()))
            seeds = ", ".join(map(str, self.missing))
            each = f"seed {seeds}: " if self.by_seed else ""
            return NotComputed(each + "; ".join(reasons))
        absent = NotComputed("this evaluation has no such score")
        values = [measures.get(measure, absent) for measures in self.by_seed.values()]
        reasons = sorted({v.reason for v in values if isinstance(v, NotComputed)})
        if reasons:
            return NotComputed("; ".join(reasons))
        return Spread.of([v for v in values if not isinstance(v, NotComputed)])


@dataclass(frozen=True)
class TableResult:
    """A table set, run. rows: by clip label, in the order of the set."""

    table: TableSet
    rows: Mapping[str, Sequence[RowResult]]


def measures_of(scores: Mapping[str, Any]) -> dict[Measure, Value]:
    """Every number of an evaluation.json, or why there is none."""
    found: dict[Measure, Value] = {
        (s["view"], s["region"], s["metric"]): from_json(s["value"]) for s in scores["scores"]
    }
    for name, value in scores["geometry"].items():
        found["geometry", "", name] = from_json(value)
    timing = scores["timing"]
    for name in ("deform_ms", "raster_ms", "total_ms"):
        reason = timing.get("not_computed")
        found["time", "", name] = NotComputed(reason) if reason else float(timing[name])
    for name in ("gaussians", "parameters", "megabytes"):
        found["size", "", name] = float(sum(part[name] for part in scores["size"]))
    return found


def mean_of_clips(rows: Sequence[RowResult]) -> RowResult:
    """One row over several clips: each seed's mean over clips; absent where any clip lacks it."""
    first = rows[0]
    missing = {seed: f"{r.clip}: {why}" for r in rows for seed, why in r.missing.items()}
    seeds = [s for s in first.by_seed if s not in missing]
    by_seed: dict[int, dict[Measure, Value]] = {}
    for seed in seeds:
        keys = dict.fromkeys(key for row in rows for key in row.by_seed[seed])
        by_seed[seed] = {key: _clip_mean(rows, seed, key) for key in keys}
    return RowResult(first.row, ALL_CLIPS, by_seed, missing)


def _clip_mean(rows: Sequence[RowResult], seed: int, key: Measure) -> Value:
    numbers = []
    for row in rows:
        value = row.by_seed[seed].get(key, NotComputed("no such score"))
        if isinstance(value, NotComputed):
            return NotComputed(f"{row.clip}: {value.reason}")
        numbers.append(value)
    return mean(numbers)
