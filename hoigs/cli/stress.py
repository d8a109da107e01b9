"""`hoigs stress`: 56 named failure cases, for every spec that they concern."""

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
from hoigs.core.machine.cpus import available_cpus
from hoigs.core.names import printable


def stress(
    cases: Annotated[
        str,
        typer.Option(
            "--cases", help="Ids and families with commas between: F01,F10,motion,camera; or all."
        ),
    ] = "all",
    specs: Annotated[
        str,
        typer.Option("--specs", help="Specs with commas between: hoigs,4dgs@matched,mine.yaml."),
    ] = "hoigs,static",
    seeds: SeedsOption = 3,
    steps: Annotated[int, typer.Option("--steps", min=1, help="Steps of every training.")] = 300,
    points: Annotated[
        int, typer.Option("--points", min=50, help="Initial Gaussians of every model.")
    ] = 4000,
    width: Annotated[int, typer.Option("--width", min=32, help="Width of the clips, pixels.")] = 96,
    whole: Annotated[
        bool, typer.Option("--whole", help="Run harder values even after a seed has failed one.")
    ] = False,
    out: Annotated[Path, typer.Option("--out", help="Folder of runs and results.")] = Path(
        "runs/stress"
    ),
    jobs: JobsOption = 1,
    threads: ThreadsOption = None,
    executor: ExecutorOption = "local",
    address: AddressOption = None,
    minutes: MinutesOption = None,
    settings: SetOption = None,
    device: DeviceOption = "cpu",
    plugin: PluginOption = None,
) -> None:
    """Find out where methods break. The same command continues an interrupted study.

    Direct checks of hoigs' own code take seconds. Cases with a sweep train on clips that get
    harder until a spec breaks. Writes stress.md, .csv and .json, stress-matrix.png and .svg, and
    stress-curves.png and .svg. The exit code is 1 if a check of hoigs' own code fails.
    """
    from hoigs.studies.execution.executor import make_executor
    from hoigs.studies.jobs.job import Job
    from hoigs.studies.jobs.variants import definition, parse_variants
    from hoigs.studies.stress.case import choose_cases
    from hoigs.studies.stress.plan import BASE, StressStudy
    from hoigs.studies.stress.report.table import make_table
    from hoigs.studies.stress.report.write import write_stress
    from hoigs.studies.stress.run import run_stress

    study = StressStudy(
        cases=choose_cases(cases),
        specs=parse_variants(specs),
        out=out.resolve(),
        seeds=seeds,
        steps=steps,
        points=points,
        base=BASE.replace("width=96", f"width={width}"),
        whole=whole,
        settings=tuple(settings or ()),
        device=study_device(device, executor),
        plugins=tuple(p.resolve() for p in plugin or ()),
    )
    each = threads or max(1, available_cpus() // jobs)
    where = make_executor(executor, jobs, each, address)

    def report(job: Job, word: str) -> None:
        typer.echo(printable(f"{job.clip_label}/{job.folder.name}: {word}"))

    limit = None if minutes is None else 60 * minutes
    verdicts = run_stress(study, executor=where, limit_s=limit, report=report, log=typer.echo)
    definitions = {row.label: definition(row) for row in study.specs}
    table = make_table(study.cases, definitions, verdicts, _about(study, jobs, each))
    for path in write_stress(table, study.out):
        typer.echo(f"wrote {path}")
    broken = sorted({v.case for v in verdicts if v.ours and v.status == "fail"})
    if any(v.status == "not run" for v in verdicts):
        typer.echo("some trainings are not done; the same command continues them")
    if broken:
        typer.echo(f"checks of hoigs' own code fail: {', '.join(broken)}")
        raise typer.Exit(1)


def _about(study: object, jobs: int, threads: int) -> dict[str, object]:
    from datetime import UTC, datetime

    from hoigs.runs.run_folder import versions
    from hoigs.studies.jobs.machine import cpu_model
    from hoigs.studies.stress.plan import StressStudy

    assert isinstance(study, StressStudy)
    return {
        "date": datetime.now(UTC).date().isoformat(),
        "direct checks": f"on {cpu_model()}",
        "trainings": f"{study.steps} steps from {study.points} Gaussians, seeds 0 to "
        f"{study.seeds - 1}, on built-in clips with {study.base.replace('&', ', ')}",
        "settings": " ".join(study.settings) or "none",
        "runs at a time": f"{jobs}, {threads} threads each, on {study.device}",
        "versions": ", ".join(f"{name} {value}" for name, value in versions().items()),
    }
