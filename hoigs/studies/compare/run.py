"""Run the cells of a comparison, and gather what they have into plain data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hoigs.core.registry.registry import default_registry
from hoigs.core.spec.schema import Spec
from hoigs.evaluation.protocol import NotComputed, Value
from hoigs.studies.compare.data import ACCURACY, Cell, CurvePoint
from hoigs.studies.execution.local import Executor
from hoigs.studies.jobs.cost import read_cost
from hoigs.studies.jobs.job import ClipFolders, Job, JobState, make_job
from hoigs.studies.jobs.results import VIEW, Measure, Row, definition, measures_of, protocol_of
from hoigs.studies.jobs.run_jobs import Report, run_jobs

# What is run: rows x rasterizers x budgets x clips x seeds.

PREVIEWS = 8  # points of a curve
ONLY_BUILTIN = "its noise needs a built-in clip"


@dataclass(frozen=True)
class Comparison:
    """What to run.

    Attributes:
        clips: folders or "builtin:NAME".
        rows: by table: of `jobs.results.parse_variants` under "", or of the paper's tables.
        rasterizers: names or keys; empty takes each spec's own.
        budgets: steps; empty takes each spec's own. seeds: how many, from 0.
        out: folder of the runs and of the results.
        settings: "a.b=value", overrides of every spec.
        device, lpips_weights, plugins: as for `hoigs train`.
    """

    clips: Sequence[str]
    rows: Mapping[str, Sequence[Row]]
    out: Path
    rasterizers: Sequence[str] = ()
    budgets: Sequence[int] = ()
    seeds: int = 1
    settings: tuple[str, ...] = ()
    device: str = "cpu"
    lpips_weights: Path | None = None
    plugins: tuple[Path, ...] = ()


@dataclass(frozen=True)
class Planned:
    """A cell without values, with its job; None where there is nothing to run."""

    cell: Cell
    job: Job | None


def plan(study: Comparison) -> list[Planned]:
    """Every cell, row by row. Built-in clips are generated here, once.

    Raises:
        HoigsError: a clip, spec, rasterizer or setting that does not exist; nothing has been run.
    """
    folders = ClipFolders()
    for clip in study.clips:
        folders.get(clip)
    rasterizers: Sequence[str | None] = study.rasterizers or [None]
    budgets: Sequence[int | None] = study.budgets or [None]
    return [
        _planned(study, _Place(table, row, rasterizer, budget, clip, seed), folders)
        for table, rows in study.rows.items()
        for clip in study.clips
        for row in rows
        for rasterizer in rasterizers
        for budget in budgets
        for seed in range(study.seeds)
    ]


@dataclass(frozen=True)
class _Place:
    """Of a cell; None takes the spec's own."""

    table: str
    row: Row
    rasterizer: str | None
    budget: int | None
    clip: str
    seed: int


def _planned(study: Comparison, place: _Place, folders: ClipFolders) -> Planned:
    from hoigs.synthesis.named import is_named

    row, clip, rasterizer = place.row, place.clip, place.rasterizer
    registry = default_registry(list(study.plugins))
    what = definition(row) if row.spec else ""
    cell = Cell(row.label, what, "", 0, folders.get(clip)[1], place.seed,
                table=place.table)  # fmt: skip
    if row.spec is None:
        return Planned(replace(cell, missing=row.why), None)
    if row.clip_settings:
        if not is_named(clip):
            return Planned(replace(cell, missing=ONLY_BUILTIN), None)
        clip = f"{clip}{'&' if '?' in clip else '?'}{row.clip_settings}"
    settings = [*study.settings, *row.settings]  # a row overrides the study
    if rasterizer is not None:
        key = rasterizer if ":" in rasterizer else f"rasterizer:{rasterizer}"
        settings.append(f"rasterizer.use={key}")
    if place.budget is not None:
        settings.append(f"train.steps={place.budget}")
    own = Spec.load(row.spec, overrides=settings, registry=registry)
    # a few previews of any budget make its curve; --set train.preview_every takes precedence
    previews = f"train.preview_every={max(1, own.train.steps // PREVIEWS)}"
    settings = [previews, *settings, f"train.seed={place.seed}"]
    folder, label, digest = folders.get(clip)
    job = make_job(
        study.out, folder, label, digest, row.spec, settings, device=study.device,
        lpips_weights=str(study.lpips_weights) if study.lpips_weights else None,
        plugins=tuple(map(str, study.plugins)),
    )  # fmt: skip
    name = own.rasterizer.use.removeprefix("rasterizer:")
    run = str(job.folder.relative_to(study.out))
    return Planned(replace(cell, rasterizer=name, steps=own.train.steps, run=run), job)


# axis name -> measure of an evaluation
MEASURES: dict[str, Measure] = {
    **{a.name: (VIEW, a.name.partition("_")[2], a.name.partition("_")[0]) for a in ACCURACY},
    "render_ms": ("time", "", "total_ms"),
    "parameters": ("size", "", "parameters"),
    "megabytes": ("size", "", "megabytes"),
}


def run_comparison(
    study: Comparison,
    *,
    executor: Executor | None = None,
    limit_s: float | None = None,
    report: Report | None = None,
) -> list[Cell]:
    """Run what is not done yet, and gather all cells; see `run_jobs`."""
    planned = plan(study)
    # two labels of one training are one job
    jobs = {p.job.run: p.job for p in planned if p.job is not None}
    failed = run_jobs(list(jobs.values()), executor, limit_s=limit_s, report=report)
    return [gather(p, failed) for p in planned]


def gather(planned: Planned, failed: Mapping[str, str]) -> Cell:
    """One cell as plain data; `failed` has the errors, by run folder."""
    cell, job = planned.cell, planned.job
    if job is None:
        return cell
    if job.state() is not JobState.done:
        return replace(cell, missing=failed.get(job.run, "not run yet"))
    return replace(cell, **measured(job))


def measured(job: Job) -> dict[str, Any]:
    """The fields machine, values, protocol, curve and at_once of a job that is done."""
    scores, cost = job.scores(), read_cost(job.folder)
    absent = NotComputed("this evaluation has no such score")
    found = measures_of(scores)
    values: dict[str, Value] = {name: found.get(key, absent) for name, key in MEASURES.items()}
    values |= {"/".join(key): value for key, value in found.items()}
    values |= {"train_s": cost.train_s, "joules": cost.joules, "memory_mb": cost.memory_mb}
    return {
        "machine": " and ".join(cost.machines) or "a machine that is not on record",
        "values": values,
        "protocol": protocol_of(scores, cost),
        "curve": curve_of(job.folder),
        "at_once": cost.runs_at_once,
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
