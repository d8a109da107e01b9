"""`hoigs tables`: the paper's ablations and comparisons on given clips."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

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
    study_device,
)
from hoigs.cli.evaluate import LpipsOption
from hoigs.core.names import printable


def tables(
    clips: Annotated[
        str, typer.Option("--clips", help="Clip folders or builtin:NAME, with commas between.")
    ],
    table: Annotated[
        list[str] | None,
        typer.Option("--table", help="Name of a table; default all. Repeatable."),
    ] = None,
    specs: Annotated[
        str,
        typer.Option(
            "--specs", help="Also, or instead, a table of these specs: hoigs,4dgs@matched."
        ),
    ] = "",
    seeds: SeedsOption = 3,
    steps: Annotated[
        int | None,
        typer.Option("--steps", min=1, help="Steps of every training; default each spec's own."),
    ] = None,
    out: Annotated[Path, typer.Option("--out", help="Folder of runs and tables.")] = Path(
        "runs/tables"
    ),
    jobs: JobsOption = 1,
    threads: ThreadsOption = None,
    executor: ExecutorOption = "local",
    address: AddressOption = None,
    minutes: MinutesOption = None,
    settings: SetOption = None,
    device: DeviceOption = "auto",
    lpips_weights: LpipsOption = None,
    plugin: PluginOption = None,
) -> None:
    """Compare methods on clips in tables. The same command continues an interrupted study.

    Tables: comparison, ablation-object-motion, ablation-interaction, ablation-human-feature,
    object-prior, mask-depth-source. Writes tables.md, tables.csv and tables.json.
    """
    from hoigs.runs.run_folder import versions
    from hoigs.studies.execution.executor import make_executor
    from hoigs.studies.jobs.job import Job
    from hoigs.studies.tables.run import Study, circumstances, protocols, run_study
    from hoigs.studies.tables.sets import choose_sets
    from hoigs.studies.tables.write import write_tables

    study = Study(
        clips=_split(clips),
        sets=choose_sets(table or (), _split(specs)),
        out=out.resolve(),
        seeds=seeds,
        steps=steps,
        settings=tuple(settings or ()),
        device=study_device(device, executor),
        lpips_weights=lpips_weights.resolve() if lpips_weights else None,
        plugins=tuple(p.resolve() for p in plugin or ()),
    )
    where = make_executor(executor, jobs, threads, address)
    ended = 0

    def report(job: Job, word: str) -> None:
        nonlocal ended
        ended += word not in ("started", "stopped")
        typer.echo(printable(f"[{ended:>3}] {job.clip_label}/{job.folder.name}: {word}"))

    limit = None if minutes is None else 60 * minutes
    results = run_study(study, executor=where, limit_s=limit, report=report)
    about: dict[str, object] = {
        "clips": ", ".join(study.clips),
        "seeds": seeds,
        "steps": "each spec's own" if steps is None else steps,
        "settings": " ".join(study.settings) or "none",
        "spread": "sample standard deviation over seeds (± in the tables)",
        "times": circumstances(study, results),
        "versions": ", ".join(f"{name} {value}" for name, value in versions().items()),
    }
    for clip, sentences in protocols(study, results).items():
        about[f"protocol of {clip}"] = " ".join(sentences)
    for path in write_tables(results, study.out, about):
        typer.echo(f"wrote {path}")
    if any(r.missing and r.row.spec for t in results for rows in t.rows.values() for r in rows):
        typer.echo("some rows are not computed; the tables give the reason")


def _split(names: str) -> list[str]:
    return [name.strip() for name in names.split(",") if name.strip()]
