"""The verbs that train and score: `hoigs train`, `eval`, `needs` and `compress`."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hoigs.cli.common import (
    ClipOption,
    DeviceOption,
    Display,
    OverwriteOption,
    PluginOption,
    Talk,
    print_scores,
    print_summary,
    print_table,
    say,
    with_json,
)
from hoigs.cli.options import flags
from hoigs.core.errors import HoigsError
from hoigs.evaluation.options import EvaluateOptions
from hoigs.studies.needs.options import NeedsOptions
from hoigs.training.options import TrainOptions

if TYPE_CHECKING:
    from hoigs.studies.needs.after_training import After
    from hoigs.studies.needs.result import Needs


# `hoigs study needs`: find how much of a spec a clip needs; the answer is a spec.


@with_json
@flags(NeedsOptions)
def needs(
    clip: Annotated[
        str, typer.Argument(help="Clip folder, as `hoigs prepare` makes it, or builtin:NAME.")
    ],
    *,
    options: NeedsOptions,
) -> None:
    """Find the smallest model that a clip needs, part by part, on training frames held back.

    Writes spec.yaml, needs.md, needs.json, needs.png and needs.svg.
    """
    from hoigs.studies.needs.needs import needs as find
    from hoigs.studies.needs.needs import needs_folder

    with Display() as show:
        found = find(clip, options=options, report=show.line)
    print_needs(found)
    answer = Path(options.out or needs_folder(clip)) / "spec.yaml"
    typer.echo(f"train it: hoigs train {clip} --spec {answer}")


def print_needs(found: Needs) -> None:
    """A table for each search space, then the method."""
    from hoigs.studies.needs.report import method, row

    columns = ("candidate", "held-back dB", "gain over chosen dB", "parameters", "steps", "verdict")
    for answer in found.answers:
        if answer.steps:
            print_table(answer.title, columns, [row(answer, step) for step in answer.steps])
    for sentence in method(found):
        typer.echo(sentence)


@with_json
@flags(TrainOptions)
def train(
    clip: Annotated[
        str | None,
        typer.Argument(
            help="Clip folder, as `hoigs prepare` makes it, or builtin:NAME. Default with "
            "--resume: the run's."
        ),
    ] = None,
    auto: Annotated[
        bool,
        typer.Option(
            "--auto",
            help="First reduce the spec to what this clip needs (`hoigs study needs`); after "
            "training, prune and compress the model.",
        ),
    ] = False,
    smallest: Annotated[
        bool,
        typer.Option(
            "--smallest",
            help="With --auto: search longer, for a model that is as small as can be, at a loss.",
        ),
    ] = False,
    *,
    options: TrainOptions,
) -> None:
    """Fit a model to a clip; then score it and write report.html."""
    if smallest and not auto:
        raise HoigsError("--smallest is a way of --auto: give both, or neither")
    with Display() as show:
        callbacks: dict[str, Any] = {
            "on_start": show.started, "on_step": show.step, "progress": show.fraction,
            "report": show.line,
        }  # fmt: skip
        if auto:
            from hoigs.studies.needs.auto import auto as train_auto

            made = train_auto(
                clip, options=options, smallest=smallest, on_found=print_needs, **callbacks
            )
            run = made.run
        else:
            from hoigs.training.train import train as train_spec

            run = train_spec(clip, options=options, **callbacks)
    if auto:
        _print_after(made.after)
    if run.evaluated is None:
        return
    if Talk.verbose or Talk.tables is not None:
        print_scores(run.evaluated)
    else:
        print_summary({run.session.spec.name: run})
        say("all scores, and how they were taken, are in the report")
    say(f"look at it: hoigs view {shlex.quote(str(run.path))}")


def _print_after(after: After) -> None:
    """The result of pruning and compression."""
    from hoigs.studies.needs.after_training import sentences, table

    columns, rows = table(after)
    print_table("after the training", columns, rows)
    for sentence in sentences(after):
        typer.echo(sentence)


# `hoigs eval`: score a run on its test frames and held-out cameras.


@with_json
@flags(EvaluateOptions)
def evaluate(
    run: Annotated[Path, typer.Argument(help="Run folder, as `hoigs train` makes it.")],
    *,
    options: EvaluateOptions,
) -> None:
    """Score a run, print the table, and write evaluation.json and report.html.

    Under another --test-pose or --test-camera than the spec's, only the scores are written, as
    evaluation-POSE-CAMERA.json beside the run's own.
    """
    from hoigs.evaluation.evaluate_run import evaluate as evaluate_run

    with Display() as show:
        done = evaluate_run(run, options=options, progress=show.fraction)
    print_scores(done)
    typer.echo(f"report: {done.report}" if done.report else f"scores: {done.scores}")


# `hoigs compress`: quantise the model of a run, and print what that costs.


def compress(
    run: Annotated[Path, typer.Argument(help="Run folder, as `hoigs train` makes it.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder of the compressed run; default RUN-compact."),
    ] = None,
    clip: ClipOption = None,
    device: DeviceOption = "auto",
    overwrite: OverwriteOption = False,
    plugin: PluginOption = None,
) -> None:
    """Quantise a trained model to 8 and 16 bits a number and compress it.

    The result is a run for eval, render and view; it cannot be trained further.
    """
    from hoigs.studies.needs.compress import compress as compress_run

    done = compress_run(
        run, out=out, clip=clip, device=device, overwrite=overwrite, plugins=plugin or ()
    )
    typer.echo(str(done))
    frames = ", ".join(map(str, done.frames))
    typer.echo(f"scored on training frames {frames}: people and objects, and background")
    typer.echo(f"run: {done.path}")
