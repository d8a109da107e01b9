"""`hoigs eval`: score a run on its test frames and held-out cameras."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hoigs.cli.common import ClipOption, DeviceOption, PluginOption, RasterizerOption
from hoigs.cli.display import Display, print_scores

LpipsOption = Annotated[
    Path | None,
    typer.Option(
        "--lpips-weights",
        help="File of LPIPS weights; default $HOIGS_LPIPS_WEIGHTS, or else AlexNet's, shipped.",
    ),
]


def evaluate(
    run: Annotated[Path, typer.Argument(help="Run folder, as `hoigs train` makes it.")],
    clip: ClipOption = None,
    rasterizer: RasterizerOption = None,
    lpips_weights: LpipsOption = None,
    device: DeviceOption = "auto",
    test_pose: Annotated[
        str | None,
        typer.Option(
            "--test-pose",
            help="Body poses of test frames: auto (blended if the clip's are estimates), "
            "given, interpolated (from training frames), blended (between both) or fitted (to the "
            "test images). "
            "Default: the spec's.",
        ),
    ] = None,
    test_camera: Annotated[
        str | None,
        typer.Option(
            "--test-camera", help="Cameras of test frames: given, interpolated or fitted."
        ),
    ] = None,
    fit_steps: Annotated[
        int | None, typer.Option("--fit-steps", min=1, help="Steps for each frame with fitted.")
    ] = None,
    report: Annotated[bool, typer.Option("--report/--no-report", help="Write report.html.")] = True,
    plugin: PluginOption = None,
) -> None:
    """Score a run, print the table, and write evaluation.json and report.html.

    Under another --test-pose or --test-camera than the spec's, only the scores are written, as
    evaluation-POSE-CAMERA.json beside the run's own.
    """
    from hoigs.workflows.evaluate import evaluate as evaluate_run

    with Display() as show:
        done = evaluate_run(
            run, clip=clip, rasterizer=rasterizer, lpips_weights=lpips_weights, device=device,
            test_pose=test_pose, test_camera=test_camera, fit_steps=fit_steps, report=report,
            plugins=plugin or (), progress=show.fraction,
        )  # fmt: skip
    print_scores(done)
    typer.echo(f"report: {done.report}" if done.report else f"scores: {done.scores}")
