"""`hoigs demo`: reconstruct the built-in clip, and compare with a static model."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hoigs.cli.common import DeviceOption, OverwriteOption, RasterizerOption, SetOption, print_table
from hoigs.cli.display import Display, print_scores

if TYPE_CHECKING:
    from hoigs.workflows.train import TrainedRun


def demo(
    out: Annotated[Path, typer.Option("--out", help="Run folder.")] = Path("runs/demo"),
    fast: Annotated[
        bool,
        typer.Option("--fast", help="A first look in half a minute: smaller, less sharp."),
    ] = False,
    steps: Annotated[
        int | None,
        typer.Option("--steps", help="Training steps of each model; 800, with --fast 200."),
    ] = None,
    settings: SetOption = None,
    rasterizer: RasterizerOption = None,
    device: DeviceOption = "auto",
    baseline: Annotated[
        bool | None,
        typer.Option(
            "--baseline/--no-baseline",
            help="Also train a static model for comparison; by default not with --fast.",
        ),
    ] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Generate a clip with known truth, reconstruct it, and write report.html."""
    from hoigs.workflows.demo import demo as run_demo

    began = time.perf_counter()
    with Display() as show:
        runs = run_demo(
            out=out,
            fast=fast,
            steps=steps,
            overrides=settings or (),
            rasterizer=rasterizer,
            device=device,
            baseline=baseline,
            overwrite=overwrite,
            on_start=show.started,
            on_step=show.step,
            progress=show.fraction,
            report=show.line,
        )
    for run in runs.values():
        assert run.evaluated is not None
        print_scores(run.evaluated)
    _compare(runs)
    typer.echo(f"demo took {time.perf_counter() - began:.0f} s; open {out / 'report.html'}")


def _compare(runs: dict[str, TrainedRun]) -> None:
    """PSNR of the runs, region by region, on the same test frames."""
    regions = ("full", "human_object", "human", "object", "interaction", "background")
    rows, given = [], []
    for name, run in runs.items():
        assert run.evaluated is not None
        scores = [run.evaluated.evaluation.score(region, "psnr") for region in regions]
        rows.append((name, *(f"{s:.2f}" if isinstance(s, float) else str(s) for s in scores)))
        given.append(run.evaluated.evaluation.views[0].protocol.given())
    title = "; ".join(("PSNR on test frames, dB", *filter(None, given[:1])))
    print_table(title, ("spec", *regions), rows)
