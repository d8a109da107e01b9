"""The verbs of many trainings: `hoigs study compare` and `stress`, `hoigs batch` and `work`."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hoigs.cli.options import flags
from hoigs.core.errors import HoigsError
from hoigs.core.system.files import printable
from hoigs.studies.options import (
    BatchOptions,
    CompareOptions,
    ExecutionOptions,
    StressOptions,
    WorkOptions,
)

if TYPE_CHECKING:
    from hoigs.studies.batch.batch import Batch, Work
    from hoigs.studies.jobs.job import Job
    from hoigs.studies.jobs.results import Row


@flags(CompareOptions)
def compare(
    clips: Annotated[list[str] | None, typer.Argument(help="Clip folders or builtin:NAME.")] = None,
    *,
    options: CompareOptions,
) -> None:
    """Compare accuracy and cost of methods. The same command continues an interrupted study.

    Writes chart.md, chart.csv, chart.json, and chart-CLIP.png and .svg with training curves beside
    them.
    """
    where = options.place()
    from hoigs.studies.compare.data import load_chart, merged_about
    from hoigs.studies.compare.paper import choose_tables
    from hoigs.studies.compare.run import Comparison, run_comparison
    from hoigs.studies.compare.write import write_chart
    from hoigs.studies.jobs.results import parse_variants

    if not clips and not options.add:
        raise HoigsError("name a clip: `hoigs study compare builtin:carry --specs hoigs,static`")
    loaded = {path: load_chart(path) for path in options.add}
    others = [cell for added, _ in loaded.values() for cell in added]
    rows: dict[str, Sequence[Row]] = dict(choose_tables(options.table))
    if options.specs is not None or not rows:
        rows[""] = parse_variants("hoigs,static" if options.specs is None else options.specs)
    study = Comparison(
        clips=clips or [],
        rows=rows,
        out=options.out.resolve(),
        rasterizers=[r.strip() for r in options.rasterizers.split(",") if r.strip()],
        budgets=_steps(options.budgets),
        seeds=options.seeds,
        settings=options.overrides,
        device=options.where(),
        lpips_weights=options.lpips_weights.resolve() if options.lpips_weights else None,
        plugins=tuple(p.resolve() for p in options.plugins),
    )

    cells = run_comparison(study, executor=where, limit_s=options.limit_s(), report=_report)
    at_once = sorted({c.at_once for c in cells if not c.missing}) or [options.jobs]
    about = _about(study.settings, study.device, options, at_once)
    if not clips:  # nothing was run
        about = merged_about({path: made for path, (_, made) in loaded.items()})
    for path in write_chart([*cells, *others], study.out, about, mix_machines=options.mix_machines):
        typer.echo(f"wrote {path}")
    if any(cell.missing for cell in cells):
        typer.echo("some trainings are not done; chart.md gives the reason")


def _report(job: Job, word: str) -> None:
    typer.echo(printable(f"{job.clip_label}/{job.folder.name}: {word}"))


def _steps(text: str) -> list[int]:
    words = [word.strip() for word in text.split(",") if word.strip()]
    for word in words:
        if not word.isdecimal() or int(word) < 1:
            raise HoigsError(
                f'--budgets: "{word}" is not a number of steps; expected for example 200,1000'
            )
    return list(dict.fromkeys(map(int, words)))


def _about(
    settings: tuple[str, ...],
    device: str,
    options: ExecutionOptions,
    at_once: Sequence[int],
    **more: str,
) -> dict[str, str]:
    """How a study was made, for its files."""
    from hoigs.runs.run_folder import versions

    jobs = " or ".join(map(str, at_once))
    return {
        "date": datetime.now(UTC).date().isoformat(),
        **more,
        "settings": " ".join(settings) or "none",
        "runs at a time": f"{jobs}, {options.each()} threads each, on {device}",
        "versions": ", ".join(f"{name} {value}" for name, value in versions().items()),
    }


# `hoigs study stress`: named failure cases, for every spec that they concern.


@flags(StressOptions)
def stress(*, options: StressOptions) -> None:
    """Find out where methods break. The same command continues an interrupted study.

    Each case trains on clips that get harder until a spec breaks. Writes stress.md and .json,
    stress-matrix.png and .svg, and stress-curves.png and .svg.
    """
    from hoigs.studies.jobs.results import definition, parse_variants
    from hoigs.studies.stress.case import choose_cases
    from hoigs.studies.stress.report import write_stress
    from hoigs.studies.stress.run import BASE, StressStudy, run_stress
    from hoigs.studies.stress.verdict import make_table

    study = StressStudy(
        cases=choose_cases(options.cases),
        specs=parse_variants(options.specs),
        out=options.out.resolve(),
        seeds=options.seeds,
        steps=options.steps,
        points=options.points,
        base=BASE.replace("width=96", f"width={options.width}"),
        whole=options.whole,
        settings=options.overrides,
        device=options.where(),
        plugins=tuple(p.resolve() for p in options.plugins),
    )
    where, limit = options.place(), options.limit_s()

    verdicts = run_stress(study, executor=where, limit_s=limit, report=_report, log=typer.echo)
    definitions = {row.label: definition(row) for row in study.specs}
    trainings = (
        f"{study.steps} steps from {study.points} Gaussians, seeds 0 to {study.seeds - 1}, "
        f"on built-in clips with {study.base.replace('&', ', ')}"
    )
    about = _about(study.settings, study.device, options, [options.jobs], trainings=trainings)
    table = make_table(study.cases, definitions, verdicts, about)
    for path in write_stress(table, study.out):
        typer.echo(f"wrote {path}")
    if any(v.status == "not run" for v in verdicts):
        typer.echo("some trainings are not done; the same command continues them")


# `hoigs batch` and `hoigs work`: many videos or clips, on any number of machines.

LAST = 8  # ended rows that the live table shows


@flags(BatchOptions)
def batch(
    manifest: Annotated[
        Path, typer.Argument(help="YAML or CSV: one row a video or clip, with its settings.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the rows and the summary.")],
    *,
    options: BatchOptions,
) -> None:
    """Prepare, train, evaluate and export every row of a manifest.

    The same command continues where it was stopped, stage by stage. A row that fails does not stop
    the others, and keeps its logs. Exit code 1: some rows failed.
    """
    from hoigs.studies.batch.batch import batch as run

    with _shown() as show:
        done = run(manifest, out, options=options, **show)
    if options.dry_run:
        for name, commands in done.plan.items():
            typer.echo(f"{name}:" + ("".join(f"\n  {c}" for c in commands) or " done"))
        return
    _finish(done)


@flags(WorkOptions)
def work(
    out: Annotated[Path, typer.Argument(help="Folder that `hoigs batch` was given as --out.")],
    *,
    options: WorkOptions,
) -> None:
    """Help with a batch: work on its rows that nobody works on, until none is left."""
    from hoigs.studies.batch.batch import work as run

    with _shown() as show:
        done = run(out, options=options, **show)
    _finish(done)


def _finish(done: Batch) -> None:
    for path in done.summary:
        typer.echo(f"wrote {path}")
    if done.failed:
        typer.echo(f"{len(done.failed)} of {done.rows} rows failed", err=True)
        raise typer.Exit(1)


@contextmanager
def _shown() -> Iterator[dict[str, Any]]:
    """`report` and `tick`: a live table on a terminal, else a line for each event."""
    from rich.console import Console
    from rich.live import Live

    console, table = Console(), _LiveTable()
    if not console.is_terminal:
        yield {"report": lambda work, word: typer.echo(printable(f"{work.row.name}: {word}"))}
        return
    with Live(console=console, get_renderable=table.draw, refresh_per_second=4):
        yield {"report": table.report, "tick": table.tick}


class _LiveTable:
    """Rows that run, and the last that ended."""

    def __init__(self) -> None:
        self.running: Sequence[Work] = ()
        self.ended: dict[str, str] = {}
        self.times: list[float] = []  # seconds of each row that this driver has finished

    def report(self, work: Work, word: str) -> None:
        ended = word in ("done", "done before") or word.startswith("failed")
        if ended:
            self.ended[work.row.name] = word
        if word == "done":
            self.times.append(time.monotonic() - work.taken_at)

    def tick(self, running: Sequence[Work]) -> None:
        self.running = list(running)

    def draw(self) -> Any:
        from rich.markup import escape
        from rich.table import Table

        failed = sum(word.startswith("failed") for word in self.ended.values())
        table = Table(title=f"{len(self.ended)} rows ended, {failed} failed", title_justify="left")
        for column in ("row", "stage", "seconds", "ETA", "device", "retries"):
            table.add_column(column)
        for name, word in list(self.ended.items())[-LAST:]:
            table.add_row(escape(printable(name)), escape(printable(word)), "", "", "", "")
        now = time.monotonic()
        for work in self.running:
            seconds = f"{now - work.since:.0f}" if work.process else ""
            table.add_row(
                escape(printable(work.row.name)), escape(work.stage), seconds, self._eta(work, now),
                work.device, str(work.retries),
            )  # fmt: skip
        return table

    def _eta(self, work: Work, now: float) -> str:
        """Of a row, by the mean time of the rows that this driver has finished."""
        if not self.times:
            return ""
        mean = sum(self.times) / len(self.times)
        return f"{max(0.0, mean - (now - work.taken_at)):.0f} s"
