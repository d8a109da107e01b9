"""`hoigs chart`: accuracy against cost, of specs x rasterizers x budgets x clips x seeds."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Annotated

import typer

from hoigs.cli.common import (
    DeviceOption,
    JobsOption,
    MinutesOption,
    PluginOption,
    SeedsOption,
    SetOption,
    ThreadsOption,
    pick_device,
    print_table,
)
from hoigs.cli.evaluate import LpipsOption


def chart(
    clips: Annotated[list[str] | None, typer.Argument(help="Clip folders or builtin:NAME.")] = None,
    specs: Annotated[
        str,
        typer.Option(
            "--specs",
            help="With commas between, each [LABEL=]SPEC[+KEY=VALUE…]: hoigs,mine.yaml,"
            "hoigs+interaction.use=interaction:none.",
        ),
    ] = "hoigs,static",
    rasterizers: Annotated[
        str, typer.Option("--rasterizers", help="warp,torch …; default each spec's own.")
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
    minutes: MinutesOption = None,
    add: Annotated[
        list[Path] | None,
        typer.Option("--add", help="Also draw the cells of another chart.json. Repeatable."),
    ] = None,
    mix_machines: Annotated[
        bool, typer.Option("--mix-machines", help="Draw times of several machines together.")
    ] = False,
    rerun: Annotated[
        str | None,
        typer.Option("--rerun", help="Run one cell, CLIP/RUN, again and print the difference."),
    ] = None,
    settings: SetOption = None,
    device: DeviceOption = "auto",
    lpips_weights: LpipsOption = None,
    plugin: PluginOption = None,
) -> None:
    """Chart accuracy against cost; what is done stays done, what failed is tried again.

    Writes chart.html (interactive), chart.md (who dominates whom), chart.csv, chart.json, and
    chart-CLIP.png and .svg with curves of training beside them. --rerun leaves with 1 when a PSNR
    is more than 0.05 dB off on the same machine.
    """
    each = threads or max(1, (os.cpu_count() or 1) // jobs)
    before = signal.signal(signal.SIGTERM, _stop)  # so that a plain kill ends the runs too
    try:
        if rerun is not None:
            _rerun(out, rerun, each)
            return
        from hoigs.core.errors import HoigsError
        from hoigs.studies.chart_data import load_cells
        from hoigs.studies.chart_plan import ChartStudy, parse_variants
        from hoigs.studies.chart_run import run_chart
        from hoigs.studies.chart_write import write_chart
        from hoigs.studies.job import Job

        if not clips and not add:
            raise HoigsError("name a clip: `hoigs chart builtin:carry --specs hoigs,static`")
        others = [cell for path in add or () for cell in load_cells(path)]
        study = ChartStudy(
            clips=clips or [],
            variants=parse_variants(specs),
            out=out.resolve(),
            rasterizers=[r.strip() for r in rasterizers.split(",") if r.strip()],
            budgets=_steps(budgets),
            seeds=seeds,
            settings=tuple(settings or ()),
            device=pick_device(device),
            lpips_weights=lpips_weights.resolve() if lpips_weights else None,
            plugins=tuple(p.resolve() for p in plugin or ()),
        )

        def report(job: Job, word: str) -> None:
            typer.echo(f"{job.clip_label}/{job.folder.name}: {word}")

        limit = None if minutes is None else 60 * minutes
        cells = run_chart(study, workers=jobs, threads=each, limit_s=limit, report=report)
        about = _about(study.settings, study.device, jobs, each)
        for path in write_chart([*cells, *others], study.out, about, mix_machines=mix_machines):
            typer.echo(f"wrote {path}")
        if any(cell.missing for cell in cells):
            typer.echo("some cells are not computed; chart.md says why")
    finally:
        signal.signal(signal.SIGTERM, before)


def _stop(*_: object) -> None:
    raise KeyboardInterrupt


def _steps(text: str) -> list[int]:
    from hoigs.core.errors import HoigsError

    words = [word.strip() for word in text.split(",") if word.strip()]
    for word in words:
        if not word.isdecimal() or int(word) < 1:
            raise HoigsError(f'--budgets: "{word}" is no number of steps; give some: 200,1000')
    return list(dict.fromkeys(map(int, words)))


def _about(settings: tuple[str, ...], device: str, jobs: int, threads: int) -> dict[str, object]:
    from datetime import UTC, datetime

    from hoigs.training.run_folder import versions

    return {
        "date": datetime.now(UTC).date().isoformat(),
        "settings": " ".join(settings) or "none",
        "runs at a time": f"{jobs}, {threads} threads each, on {device}",
        "versions": ", ".join(f"{name} {value}" for name, value in versions().items()),
    }


def _rerun(out: Path, cell: str, threads: int) -> None:
    from hoigs.evaluation.protocol import NotComputed
    from hoigs.studies.chart_data import AXES
    from hoigs.studies.rerun import TOLERANCE_DB
    from hoigs.studies.rerun import rerun as run_again

    found = run_again(out.resolve(), cell, threads)
    rows = []
    for name, axis in AXES.items():
        pair = (found.first[name], found.again[name])
        shown = [str(v) if isinstance(v, NotComputed) else f"{v:.4f}" for v in pair]
        difference = found.difference(name)
        rows.append((axis.title, *shown, "" if difference is None else f"{difference:+.4f}"))
    print_table(cell, ("measure", "first", "again", "difference"), rows, [f"run: {found.run}"])
    if not found.same_machine:
        typer.echo(f"two machines, nothing is asked: {found.machines[0]} | {found.machines[1]}")
        return
    word = "reproduced" if found.reproduced else "NOT reproduced"
    typer.echo(f"{word}: PSNR to {TOLERANCE_DB} dB on the same machine")
    if not found.reproduced:
        raise typer.Exit(1)
