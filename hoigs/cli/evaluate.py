"""`hoigs eval`: a run judged on its test frames and held-out cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
    from hoigs.core.train_spec import EvaluationSpec
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
    test_pose: Annotated[
        str | None,
        typer.Option(
            "--test-pose",
            help="Body poses of test frames: given, interpolated (from training frames) or fitted "
            "(to the test images themselves). Default: the spec's.",
        ),
    ] = None,
    test_camera: Annotated[
        str | None, typer.Option("--test-camera", help="Cameras of test frames, likewise.")
    ] = None,
    fit_steps: Annotated[
        int | None, typer.Option("--fit-steps", min=1, help="Steps a frame of fitted.")
    ] = None,
    report: Annotated[bool, typer.Option("--report/--no-report", help="Write report.html.")] = True,
    plugin: PluginOption = None,
) -> None:
    """Score a run, print the table, and write evaluation.json and report.html.

    Under another --test-pose or --test-camera than the spec's, only the scores are written, as
    evaluation-POSE-CAMERA.json beside the run's own.
    """
    score_run(
        run,
        clip=clip,
        rasterizer=rasterizer,
        lpips_weights=lpips_weights,
        device=pick_device(device),
        report=report,
        plugins=plugin or (),
        protocol={"test_pose": test_pose, "test_camera": test_camera, "fit_steps": fit_steps},
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
    protocol: Mapping[str, object] | None = None,
) -> Evaluation:
    """Load, score, print, write.

    Args:
        protocol: fields of EvaluationSpec in place of the spec's; None takes the spec's.

    Raises:
        HoigsError: besides what is wrong with the run, a protocol that there is not.
    """
    from hoigs.evaluation.evaluate import evaluate as judge
    from hoigs.evaluation.report import write_report
    from hoigs.training.session import LoadedRun

    loaded = LoadedRun.open(run, clip=clip, rasterizer=rasterizer, device=device, plugins=plugins)
    settings = _settings(loaded.spec.evaluation, protocol or {})
    own = settings == loaded.spec.evaluation
    with progress_bar("scoring", 1.0) as bar:
        evaluation = judge(
            loaded.model,
            loaded.clip,
            lpips_weights=lpips_weights,
            held_out=settings.held_out,
            test_pose=settings.test_pose,
            test_camera=settings.test_camera,
            fit_steps=settings.fit_steps,
            device=device,
            progress=bar.update,
        )
    name = "evaluation" if own else f"evaluation-{settings.test_pose}-{settings.test_camera}"
    evaluation.save(run / f"{name}.json")
    for table in evaluation.tables():
        print_table(table.title, table.columns, table.rows, table.notes)
    if not own:
        typer.echo(f"scores: {run / name}.json")
    elif report:
        assert evaluation.scored is not None
        path = write_report(run, loaded.model, evaluation.scored, evaluation)
        typer.echo(f"report: {path}")
    return evaluation


def _settings(spec: EvaluationSpec, changes: Mapping[str, object]) -> EvaluationSpec:
    from pydantic import ValidationError

    from hoigs.core.errors import HoigsError, did_you_mean

    chosen = {name: value for name, value in changes.items() if value is not None}
    try:
        return type(spec).model_validate(spec.model_dump() | chosen)
    except ValidationError as error:
        wrong = error.errors()[0]
        option, value = str(wrong["loc"][0]), str(wrong["input"])
        near = did_you_mean(value, ("given", "interpolated", "fitted"))
        raise HoigsError(f"--{option.replace('_', '-')} {value}: {wrong['msg']}{near}") from error
