"""Tables: a job for each row, clip and seed, and tables of their scores."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.evaluation.protocol import Protocol
from hoigs.studies.execution.local import Executor
from hoigs.studies.jobs.cost import read_cost
from hoigs.studies.jobs.job import SCORES, ClipFolders, Job, JobState, make_job
from hoigs.studies.jobs.results import Measure, Row, RowResult, TableResult, TableSet, measures_of
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


# Named tables and their rows, after the tables of the paper, all in matched settings.

UNSHIPPED = "hoigs ships no {}; prepare a clip with them and name it in --clips"


def _source(label: str, key: str, what: str) -> Row:
    return Row(label, None, paper=(f"priors/{key}",), why=UNSHIPPED.format(what))


def _method(name: str, *paper: str) -> Row:
    return Row(name, f"{name}@matched", paper=paper)


TABLE_SETS = {
    table.name: table
    for table in (
        TableSet(
            "comparison",
            "Comparison with other methods, matched settings",
            (
                _method("hoigs", "runtime/hoigs", "hosnerf/hoigs", "behave/hoigs", "arctic/hoigs",
                        "arctic-geometry/hoigs"),
                _method("hoigs-paper"),
                _method("4dgs", "runtime/4dgs", "hosnerf/4dgs", "behave/4dgs", "arctic/4dgs"),
                _method("d3dgs", "runtime/d3dgs", "hosnerf/d3dgs"),
                _method("e-d3dgs", "runtime/e-d3dgs", "hosnerf/e-d3dgs", "behave/e-d3dgs",
                        "arctic/e-d3dgs"),
                _method("ex4dgs", "runtime/ex4dgs", "hosnerf/ex4dgs"),
                _method("exavatar", "hosnerf/exavatar", "behave/exavatar"),
                _method("hugs"),
                _method("static-3dgs"),
                _method("k-planes-gs", "hosnerf/k-planes"),
                _method("nerfies-gs", "hosnerf/nerfies"),
                _method("hypernerf-gs", "hosnerf/hypernerf"),
                _method("d2nerf-gs", "hosnerf/d2nerf"),
                _method("neuman-gs", "hosnerf/neuman"),
                _method("hosnerf-gs", "hosnerf/hosnerf"),
                _method("hold-gs", "arctic/hold", "arctic-geometry/hold"),
            ),
        ),
        TableSet(
            "ablation-object-motion",
            "Ablation: how the object moves",
            (
                # the paper's has no track, which would give it the true pose of every frame
                Row("MLP", "hoigs-object-mlp@matched", ("model.object.deformation.track=false",),
                    paper=("object-motion/mlp",)),
                Row("MLP about the track's poses", "hoigs-object-mlp@matched"),
                Row("CHS that starts near the track", "hoigs@matched",
                    ("model.object.deformation.use=deformation:chs",),
                    paper=("object-motion/hoigs",)),
                Row("CHS about the track, tangents by finite differences", "hoigs-chs-fd@matched",
                    paper=("object-motion/baseline-deformation",)),
                Row("CHS about the track (hoigs)", "hoigs@matched"),
            ),
        ),
        TableSet(
            "ablation-interaction",
            "Ablation: the interaction module",
            (
                Row("off", "hoigs-no-interaction@matched", paper=("interaction/no-interaction",)),
                Row("on (hoigs)", "hoigs@matched", paper=("interaction/hoigs",)),
            ),
        ),
        TableSet(
            "ablation-human-feature",
            "Ablation: the human's features",
            (
                Row("embedding", "hoigs-human-embedding@matched",
                    paper=("interaction/no-human-feature",)),
                Row("HexPlane (hoigs)", "hoigs@matched", paper=("interaction/hoigs",)),
            ),
        ),
        TableSet(
            "object-prior",
            "Where the object's first Gaussians come from",
            (
                Row("the clip's own points", "hoigs@matched"),
                Row("masked depth", "hoigs@matched",
                    ("model.object.initializer.use=initializer:depth",),
                    paper=("object-prior/depth",)),
                Row("MASt3R", None, paper=("object-prior/mast3r",),
                    why="hoigs ships no MASt3R; give its points with --specs, initializer:points"),
                Row("diffusion (score distillation)", None, paper=("object-prior/diffusion",),
                    why="hoigs ships no diffusion weights; give yours: --specs, initializer:sds"),
            ),
        ),
        TableSet(
            "mask-depth-source",
            "Where masks and depth come from",
            (
                Row("the clip's own", "hoigs@matched"),
                Row("a third of the masks' borders wrong", "hoigs@matched",
                    clip_settings="noise.mask_boundary=0.33"),
                Row("depth with 5 % noise and 10 % holes", "hoigs@matched",
                    clip_settings="noise.depth_relative=0.05&noise.depth_holes=0.1"),
                _source("Samurai + Metric3D v2", "samurai+metric3dv2", "Samurai, no Metric3D"),
                _source("Samurai + Video Depth Anything", "samurai+vda",
                        "Samurai, no Video Depth Anything"),
                _source("Samurai + DepthCrafter", "samurai+depthcrafter",
                        "Samurai, no DepthCrafter"),
                _source("Track Anything + Metric3D v2", "trackanything+metric3dv2",
                        "Track Anything, no Metric3D"),
                _source("SAM 2 + Video Depth Anything", "sam2+vda",
                        "SAM 2, no Video Depth Anything"),
                _source("Mask R-CNN + Metric3D v2", "maskrcnn+metric3dv2",
                        "Mask R-CNN, no Metric3D"),
            ),
        ),
    )
}  # fmt: skip


def choose_sets(names: Sequence[str], specs: Sequence[str]) -> list[TableSet]:
    """The sets of these names, then one of these specs; all named sets when neither is given.

    Raises:
        HoigsError: no set of that name.
    """
    chosen = []
    for name in names or ([] if specs else list(TABLE_SETS)):
        if name not in TABLE_SETS:
            known = list(TABLE_SETS)
            raise HoigsError(
                f"no table set {name!r}; there are {', '.join(known)}{did_you_mean(name, known)}"
            )
        chosen.append(TABLE_SETS[name])
    if specs:
        rows = tuple(Row(spec, spec, paper=_of_spec(spec)) for spec in specs)
        chosen.append(TableSet("specs", "Chosen specs", rows))
    return chosen


def _of_spec(spec: str) -> tuple[str, ...]:
    """The paper's rows for the method of a spec's name, if any."""
    name = spec.partition("@")[0]
    rows = (row for row in TABLE_SETS["comparison"].rows if row.label == name)
    return next((row.paper for row in rows), ())
