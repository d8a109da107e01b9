"""Run a chart's cells, and gather what they have into plain data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hoigs.evaluation.protocol import NotComputed, Value
from hoigs.studies.chart.data import ACCURACY, Cell, CurvePoint
from hoigs.studies.chart.plan import ChartStudy, Planned, plan
from hoigs.studies.execution.executor import Executor
from hoigs.studies.jobs.cost import read_cost
from hoigs.studies.jobs.job import Job, JobState
from hoigs.studies.jobs.protocol import VIEW, protocol_of
from hoigs.studies.jobs.results import Measure, measures_of
from hoigs.studies.jobs.run_jobs import Report, run_jobs
from hoigs.studies.jobs.variants import definition

# axis name -> measure of an evaluation
MEASURES: dict[str, Measure] = {
    **{a.name: (VIEW, a.name.partition("_")[2], a.name.partition("_")[0]) for a in ACCURACY},
    "render_ms": ("time", "", "total_ms"),
    "parameters": ("size", "", "parameters"),
    "megabytes": ("size", "", "megabytes"),
}


def run_chart(
    study: ChartStudy,
    *,
    executor: Executor | None = None,
    limit_s: float | None = None,
    report: Report | None = None,
) -> list[Cell]:
    """Run what is not done yet, and gather all cells; see `run_jobs`."""
    planned = plan(study)
    jobs = {p.job.run: p.job for p in planned}  # two labels of one training are one job
    failed = run_jobs(list(jobs.values()), executor, limit_s=limit_s, report=report)
    return [gather(p, study.out, failed) for p in planned]


def gather(planned: Planned, out: Path, failed: Mapping[str, str]) -> Cell:
    """One cell as plain data; `failed` has the errors, by run folder."""
    job, row = planned.job, planned.variant
    cell = Cell(
        row.label, definition(row), planned.rasterizer, planned.steps, planned.clip, planned.seed,
        run=str(job.folder.relative_to(out)),
    )  # fmt: skip
    if job.state() is not JobState.done:
        return Cell(**(vars(cell) | {"missing": failed.get(job.run, "not run yet")}))
    return Cell(**(vars(cell) | measured(job)))


def measured(job: Job) -> dict[str, Any]:
    """The fields machine, values, protocol and curve of a job that is done."""
    scores, cost = job.scores(), read_cost(job.folder)
    absent = NotComputed("this evaluation has no such score")
    found = measures_of(scores)
    values: dict[str, Value] = {name: found.get(key, absent) for name, key in MEASURES.items()}
    values |= {"train_s": cost.train_s, "joules": cost.joules, "memory_mb": cost.memory_mb}
    return {
        "machine": " and ".join(cost.machines) or "a machine that is not on record",
        "values": values,
        "protocol": protocol_of(scores, cost),
        "curve": curve_of(job.folder),
    }


def curve_of(folder: Path) -> tuple[CurvePoint, ...]:
    """PSNR of the previews of test frames, from metrics.jsonl."""
    from hoigs.runs.run_folder import RunFolder

    records: Sequence[dict[str, Any]] = RunFolder(folder).read_metrics()
    return tuple(
        (int(r["step"]), float(r["time_s"]), float(r["psnr"]["test"]))
        for r in records
        if "test" in r.get("psnr", {})
    )
