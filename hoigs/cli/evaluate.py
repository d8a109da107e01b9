"""`hoigs eval`: a run judged on its test frames and held-out cameras."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hoigs.cli.common import (
    DeviceOption,
    PluginOption,
    RasterizerOption,
    pick_device,
    print_table,
    progress_bar,
)

if TYPE_CHECKING:
    from hoigs.evaluation.scores import Evaluation

LpipsOption = Annotated[
    Path | None,
    typer.Option("--lpips-weights", help="AlexNet LPIPS weights; else $HOIGS_LPIPS_WEIGHTS."),
]


def evaluate(
    run: Annotated[Path, typer.Argument(help="Run folder, as `hoigs train` makes it.")],
    clip: Annotated[
        Path | None, typer.Option("--clip", help="The clip, if it has moved; builtin:NAME too.")
    ] = None,
    rasterizer: RasterizerOption = None,
    lpips_weights: LpipsOption = None,
    device: DeviceOption = "auto",
    report: Annotated[bool, typer.Option("--report/--no-report", help="Write report.html.")] = True,
    plugin: PluginOption = None,
) -> None:
    """Score a run, print the table, and write evaluation.json and report.html."""
    score_run(
        run,
        clip=clip,
        rasterizer=rasterizer,
        lpips_weights=lpips_weights,
        device=pick_device(device),
        report=report,
        plugins=plugin or (),
    )


def score_run(
    run: Path,
    *,
    clip: Path | None = None,
    rasterizer: str | None = None,
    lpips_weights: Path | None = None,
    device: str = "cpu",
    report: bool = True,
    plugins: Sequence[Path] = (),
) -> Evaluation:
    """Load, score, print, write."""
    from hoigs.evaluation.evaluate import evaluate as judge
    from hoigs.evaluation.report import write_report
    from hoigs.training.session import LoadedRun

    loaded = LoadedRun.open(run, clip=clip, rasterizer=rasterizer, device=device, plugins=plugins)
    with progress_bar("scoring", 1.0) as bar:
        evaluation = judge(
            loaded.model,
            loaded.clip,
            lpips_weights=lpips_weights,
            held_out=loaded.spec.evaluation.held_out,
            test_pose=loaded.spec.evaluation.test_pose,
            device=device,
            progress=bar.update,
        )
    evaluation.save(run / "evaluation.json")
    for table in evaluation.tables():
        print_table(table.title, table.columns, table.rows, table.notes)
    if report:
        path = write_report(run, loaded.model, loaded.clip, evaluation)
        typer.echo(f"report: {path}")
    return evaluation
