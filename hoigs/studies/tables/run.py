"""Tables: a job for each row, clip and seed, and tables of their scores."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hoigs.core.errors import HoigsError
from hoigs.evaluation.protocol import Protocol
from hoigs.studies.execution.executor import Executor
from hoigs.studies.jobs.clip_folders import ClipFolders
from hoigs.studies.jobs.cost import read_cost
from hoigs.studies.jobs.job import SCORES, Job, JobState, make_job
from hoigs.studies.jobs.results import Measure, RowResult, TableResult, measures_of
from hoigs.studies.jobs.rows import Row, TableSet
from hoigs.studies.jobs.run_jobs import Report, run_jobs

ONLY_BUILTIN = "its noise needs a built-in clip"


@dataclass(frozen=True)
class Study:
    """What to run.

    Attributes:
        clips: CLIP arguments: folders or "builtin:NAME". sets: tables.
        out: folder of the runs and of the tables.
        seeds: how many, from 0. steps: of every training; None is each spec's own.
        settings: "a.b=value", overrides of every spec.
        device, lpips_weights, plugins: as for `hoigs train`.
    """

    clips: Sequence[str]
    sets: Sequence[TableSet]
    out: Path
    seeds: int = 3
    steps: int | None = None
    settings: tuple[str, ...] = ()
    device: str = "cpu"
    lpips_weights: Path | None = None
    plugins: tuple[Path, ...] = ()

    def overrides(self, row: Row, seed: int) -> list[str]:
        steps = [] if self.steps is None else [f"train.steps={self.steps}"]
        return [*row.settings, *self.settings, *steps, f"train.seed={seed}"]


@dataclass(frozen=True)
class Cell:
    """A row on a clip with a seed: a job, or the reason why there is none."""

    table: str
    row: Row
    clip: str
    seed: int
    job: Job | None
    why: str = ""


def plan(study: Study) -> list[Cell]:
    """Every cell of every table. Built-in clips are generated here, once.

    Raises:
        ClipError: a clip that does not exist; nothing has been run by then.
    """
    folders = ClipFolders()
    for clip in study.clips:
        folders.get(clip)
    return [
        _cell(study, table, row, clip, seed, folders)
        for table in study.sets
        for row in table.rows
        for clip in study.clips
        for seed in range(study.seeds)
    ]


def _cell(
    study: Study, table: TableSet, row: Row, clip: str, seed: int, folders: ClipFolders
) -> Cell:
    empty = Cell(table.name, row, clip, seed, None)
    if row.spec is None:
        return replace(empty, why=row.why)
    named = clip
    if row.clip_settings:
        from hoigs.synthesis.named import is_named

        if not is_named(clip):
            return replace(empty, why=ONLY_BUILTIN)
        named = f"{clip}{'&' if '?' in clip else '?'}{row.clip_settings}"
    folder, label, digest = folders.get(named)
    try:
        job = make_job(
            study.out, folder, label, digest, row.spec, study.overrides(row, seed),
            device=study.device,
            lpips_weights=str(study.lpips_weights) if study.lpips_weights else None,
            plugins=tuple(map(str, study.plugins)),
        )  # fmt: skip
    except HoigsError as error:
        return replace(empty, why=" ".join(str(error).split()))
    return replace(empty, job=job)


def run_study(
    study: Study,
    *,
    executor: Executor | None = None,
    limit_s: float | None = None,
    report: Report | None = None,
) -> list[TableResult]:
    """Run the jobs that are not done, and gather all tables; see `run_jobs`."""
    cells = plan(study)
    jobs = {cell.job.run: cell.job for cell in cells if cell.job is not None}
    failed = run_jobs(list(jobs.values()), executor, limit_s=limit_s, report=report)
    return gather(study, cells, failed)


def gather(study: Study, cells: Sequence[Cell], failed: Mapping[str, str]) -> list[TableResult]:
    """Tables of the results so far; `failed` has the errors, by run folder."""
    cache: dict[str, dict[Measure, Any]] = {}
    results = []
    for table in study.sets:
        rows: dict[str, list[RowResult]] = {clip: [] for clip in study.clips}
        for row in table.rows:
            for clip in study.clips:
                own = [c for c in cells if (c.table, c.row, c.clip) == (table.name, row, clip)]
                rows[clip].append(_row_result(study, row, clip, own, failed, cache))
        results.append(TableResult(table, rows))
    return results


def _row_result(
    study: Study,
    row: Row,
    clip: str,
    cells: Sequence[Cell],
    failed: Mapping[str, str],
    cache: dict[str, dict[Measure, Any]],
) -> RowResult:
    by_seed, missing, runs = {}, {}, {}
    for cell in cells:
        if cell.job is None:
            missing[cell.seed] = cell.why
            continue
        runs[cell.seed] = str(cell.job.folder.relative_to(study.out))
        if cell.job.state() is not JobState.done:
            missing[cell.seed] = failed.get(cell.job.run, "not run yet")
            continue
        if cell.job.run not in cache:
            cache[cell.job.run] = measures_of(cell.job.scores())
        by_seed[cell.seed] = cache[cell.job.run]
    return RowResult(row, clip, by_seed, missing, runs)


def circumstances(study: Study, results: Sequence[TableResult]) -> str:
    """On which machines the runs with scores were trained and timed, and beside how many others."""
    done = {
        row.runs[seed]
        for result in results
        for rows in result.rows.values()
        for row in rows
        for seed in row.by_seed
    }
    costs = [read_cost(study.out / run) for run in sorted(done)]
    machines = sorted({word for cost in costs for word in cost.machines})
    beside = sorted({cost.runs_at_once - 1 for cost in costs})
    if not machines:
        return "no machine is on record"
    return f"measured on {' and '.join(machines)}, beside {_span(beside)} other runs"


def _span(numbers: Sequence[int]) -> str:
    return str(numbers[0]) if len(numbers) == 1 else f"{numbers[0]} to {numbers[-1]}"


def protocols(study: Study, results: Sequence[TableResult]) -> dict[str, list[str]]:
    """How each clip was scored, in sentences, from the first run of it that has scores."""
    found: dict[str, list[str]] = {}
    for result in results:
        for clip, rows in result.rows.items():
            done = [row.runs[seed] for row in rows for seed in row.by_seed]
            if clip not in found and done:
                scores = json.loads((study.out / done[0] / SCORES).read_text())
                found[clip] = Protocol(**scores["scores"][0]["protocol"]).footnotes()
    return found
