"""`hoigs demo`: the built-in clip, reconstructed, judged and compared with a static model."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hoigs.cli.common import (
    DeviceOption,
    RasterizerOption,
    SetOption,
    overrides,
    pick_device,
    print_table,
)

if TYPE_CHECKING:
    from hoigs.evaluation.scores import Evaluation


def demo(
    out: Annotated[Path, typer.Option("--out", help="Run folder.")] = Path("runs/demo"),
    steps: Annotated[int, typer.Option("--steps", help="Training steps of each model.")] = 800,
    settings: SetOption = None,
    rasterizer: RasterizerOption = None,
    device: DeviceOption = "auto",
    baseline: Annotated[
        bool, typer.Option("--baseline/--no-baseline", help="Also train a static model to compare.")
    ] = True,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an earlier demo.")
    ] = False,
) -> None:
    """Generate a clip with known truth, reconstruct it, and write report.html."""
    from hoigs.cli.evaluate import score_run
    from hoigs.cli.train import run_session
    from hoigs.core.registry import default_registry
    from hoigs.synthesis import builtin_clip
    from hoigs.training.run_folder import RunFolder
    from hoigs.training.session import Session

    began = time.perf_counter()
    where = pick_device(device)
    runs = {"hoigs": out}
    if baseline:
        runs["static"] = out.with_name(f"{out.name}-static")
    for folder in runs.values():  # before the first has trained for minutes
        RunFolder(folder).refuse_existing(overwrite)
    typer.echo("generating the built-in clip (once; cached afterwards)")
    clip = builtin_clip(default_registry().get("body:anny")())
    evaluations = {}
    for spec, folder in runs.items():
        session = Session.open(
            clip,
            spec,
            out=folder,
            overrides=[f"train.steps={steps}", *overrides(settings, rasterizer)],
            device=where,
            overwrite=overwrite,
        )
        run_session(session)
        evaluations[spec] = score_run(folder, device=where)
    _compare(evaluations)
    typer.echo(f"demo took {time.perf_counter() - began:.0f} s; open {out / 'report.html'}")


def _compare(evaluations: dict[str, Evaluation]) -> None:
    """PSNR of the runs, region by region, on the same test frames."""
    regions = ("full", "human_object", "human", "object", "interaction", "background")
    rows = []
    for name, evaluation in evaluations.items():
        scores = [evaluation.score(region, "psnr") for region in regions]
        rows.append((name, *(f"{s:.2f}" if isinstance(s, float) else str(s) for s in scores)))
    print_table("PSNR on test frames, dB", ("spec", *regions), rows)
