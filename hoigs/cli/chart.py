"""`hoigs chart`: accuracy against cost, for specs, rasterizers, budgets, clips and seeds."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hoigs.cli.common import (
    AddressOption,
    DeviceOption,
    ExecutorOption,
    JobsOption,
    MinutesOption,
    PluginOption,
    SeedsOption,
    SetOption,
    ThreadsOption,
    print_table,
    study_device,
)
from hoigs.cli.evaluate import LpipsOption
from hoigs.core.machine.cpus import available_cpus
from hoigs.core.names import printable

if TYPE_CHECKING:
    from hoigs.studies.execution.executor import Executor


def chart(
    clips: Annotated[list[str] | None, typer.Argument(help="Clip folders or builtin:NAME.")] = None,
    specs: Annotated[
        str,
        typer.Option(
            "--specs",
            help="Specs with commas between, each [LABEL=]SPEC[+KEY=VALUE…]: hoigs,mine.yaml,"
            "hoigs+interaction.use=interaction:none.",
        ),
    ] = "hoigs,static",
    rasterizers: Annotated[
        str,
        typer.Option("--rasterizers", help="Rasterizers: warp,torch …; default each spec's own."),
    ] = "",
    budgets: Annotated[
        str, typer.Option("--budgets", help="Steps: 200,1000; default each spec's own.")
    ] = "",
    seeds: SeedsOption = 3,
    out: Annotated[Path, typer.Option("--out", help="Folder of runs and charts.")] = Path(
        "runs/chart"
    ),
    jobs: JobsOption = 1,
    threads: ThreadsOption = None,
    executor: ExecutorOption = "local",
    address: AddressOption = None,
    minutes: MinutesOption = None,
    add: Annotated[
        list[Path] | None,
        typer.Option(
            "--add",
            help="Also draw the results of this chart.json; without CLIPS, only those. Repeatable.",
        ),
    ] = None,
    mix_machines: Annotated[
        bool,
        typer.Option("--mix-machines", help="Draw times that were measured on different machines."),
    ] = False,
    rerun: Annotated[
        str | None,
        typer.Option("--rerun", help="Train CLIP/RUN again and print the differences."),
    ] = None,
    settings: SetOption = None,
    device: DeviceOption = "auto",
    lpips_weights: LpipsOption = None,
    plugin: PluginOption = None,
) -> None:
    """Chart accuracy against cost. The same command continues an interrupted study.

    Writes chart.html (interactive, needs plotly: pip install 'hoigs[charts]'), chart.md,
    chart.csv, chart.json, and chart-CLIP.png and .svg with training curves beside them. With
    --rerun, the exit code is 1 if a PSNR differs by more than 0.05 dB on the same machine.
    """
    from hoigs.studies.execution.executor import make_executor

    each = threads or max(1, available_cpus() // jobs)
    where = make_executor(executor, jobs, each, address)
    if rerun is not None:
        _rerun(out, rerun, where)
        return
    from hoigs.core.errors import HoigsError
    from hoigs.studies.chart.data import load_chart, merged_about
    from hoigs.studies.chart.interactive import require_plotly
    from hoigs.studies.chart.plan import ChartStudy
    from hoigs.studies.chart.run import run_chart
    from hoigs.studies.chart.write import write_chart
    from hoigs.studies.jobs.job import Job
    from hoigs.studies.jobs.variants import parse_variants

    if not clips and not add:
        raise HoigsError("name a clip: `hoigs chart builtin:carry --specs hoigs,static`")
    require_plotly()
    loaded = {path: load_chart(path) for path in add or ()}
    others = [cell for added, _ in loaded.values() for cell in added]
    study = ChartStudy(
        clips=clips or [],
        variants=parse_variants(specs),
        out=out.resolve(),
        rasterizers=[r.strip() for r in rasterizers.split(",") if r.strip()],
        budgets=_steps(budgets),
        seeds=seeds,
        settings=tuple(settings or ()),
        device=study_device(device, executor),
        lpips_weights=lpips_weights.resolve() if lpips_weights else None,
        plugins=tuple(p.resolve() for p in plugin or ()),
    )

    def report(job: Job, word: str) -> None:
        typer.echo(printable(f"{job.clip_label}/{job.folder.name}: {word}"))

    limit = None if minutes is None else 60 * minutes
    cells = run_chart(study, executor=where, limit_s=limit, report=report)
    about = _about(study.settings, study.device, jobs, each)
    if not clips:  # nothing was run
        about = merged_about({path: made for path, (_, made) in loaded.items()})
    for path in write_chart([*cells, *others], study.out, about, mix_machines=mix_machines):
        typer.echo(f"wrote {path}")
    if any(cell.missing for cell in cells):
        typer.echo("some trainings are not done; chart.md gives the reason")


def _steps(text: str) -> list[int]:
    from hoigs.core.errors import HoigsError

    words = [word.strip() for word in text.split(",") if word.strip()]
    for word in words:
        if not word.isdecimal() or int(word) < 1:
            raise HoigsError(
                f'--budgets: "{word}" is not a number of steps; expected for example 200,1000'
            )
    return list(dict.fromkeys(map(int, words)))


def _about(settings: tuple[str, ...], device: str, jobs: int, threads: int) -> dict[str, object]:
    from datetime import UTC, datetime

    from hoigs.runs.run_folder import versions

    return {
        "date": datetime.now(UTC).date().isoformat(),
        "settings": " ".join(settings) or "none",
        "runs at a time": f"{jobs}, {threads} threads each, on {device}",
        "versions": ", ".join(f"{name} {value}" for name, value in versions().items()),
    }


def _rerun(out: Path, cell: str, executor: Executor) -> None:
    from hoigs.evaluation.protocol import NotComputed
    from hoigs.studies.chart.data import AXES
    from hoigs.studies.chart.rerun import TOLERANCE_DB
    from hoigs.studies.chart.rerun import rerun as run_again

    found = run_again(out.resolve(), cell, executor)
    rows = []
    for name, axis in AXES.items():
        pair = (found.first[name], found.again[name])
        shown = [str(v) if isinstance(v, NotComputed) else f"{v:.4f}" for v in pair]
        difference = found.difference(name)
        rows.append((axis.title, *shown, "" if difference is None else f"{difference:+.4f}"))
    print_table(cell, ("measure", "first", "again", "difference"), rows, [f"run: {found.run}"])
    if not found.same_machine:
        typer.echo(f"two machines, so not compared: {found.machines[0]} | {found.machines[1]}")
        return
    word = "reproduced" if found.reproduced else "NOT reproduced"
    typer.echo(f"{word}: PSNR to {TOLERANCE_DB} dB on the same machine")
    if not found.reproduced:
        raise typer.Exit(1)
