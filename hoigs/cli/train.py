"""`hoigs train`: fit a spec to a clip; the result is a run folder."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hoigs.cli.common import (
    AllowFaultsOption,
    DeviceOption,
    OverwriteOption,
    PluginOption,
    RasterizerOption,
    SetOption,
    print_table,
)
from hoigs.cli.display import Display, print_scores
from hoigs.cli.needs import print_needs

if TYPE_CHECKING:
    from hoigs.studies.needs.after_training import After


def train(
    clip: Annotated[
        str | None,
        typer.Argument(
            help="Clip folder, as `hoigs prepare` makes it, or builtin:NAME. Default with "
            "--resume: the run's."
        ),
    ] = None,
    spec: Annotated[
        str | None,
        typer.Option(
            "--spec",
            help="A built-in spec's name or a file; @PROFILE may follow. Default hoigs; with "
            "--resume the run's.",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Run folder; default runs/CLIP-SPEC.")
    ] = None,
    settings: SetOption = None,
    rasterizer: RasterizerOption = None,
    device: DeviceOption = "auto",
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Continue the run in --out, with its own spec and clip."),
    ] = False,
    overwrite: OverwriteOption = False,
    allow_faults: AllowFaultsOption = False,
    reader: Annotated[
        str | None,
        typer.Option(
            "--reader",
            help="Reader of the dataset layout of CLIP; default: the one that recognises it.",
        ),
    ] = None,
    reader_set: Annotated[
        list[str] | None,
        typer.Option("--reader-set", help="A setting of the reader: masks=false. Repeatable."),
    ] = None,
    auto: Annotated[
        bool,
        typer.Option(
            "--auto",
            help="First reduce the spec to what this clip needs (`hoigs needs`); after training, "
            "prune and compress the model.",
        ),
    ] = False,
    budget: Annotated[
        str | None,
        typer.Option(
            "--budget",
            help="A time, 90s, 20m or 2h: width and steps that fit it on this machine.",
        ),
    ] = None,
    chunk: Annotated[
        int | None,
        typer.Option(
            "--chunk",
            help="For a long clip, to save memory: train in windows of this many frames, of which "
            "one is in memory at a time. Short windows, of 16 frames, cost the least time.",
        ),
    ] = None,
    evaluate: Annotated[
        bool, typer.Option("--eval/--no-eval", help="Score the run and write its report.")
    ] = True,
    view: Annotated[
        bool, typer.Option("--view", help="Show the training in the browser while it lasts.")
    ] = False,
    port: Annotated[
        int, typer.Option("--port", help="Of --view, on this machine; 0 finds a free one.")
    ] = 8090,
    plugin: PluginOption = None,
) -> None:
    """Fit a model to a clip; then score it and write report.html."""
    from hoigs.studies.needs.auto import auto as train_auto
    from hoigs.workflows.train import train as train_spec

    with Display() as show:
        given: dict[str, Any] = {
            "out": out, "overrides": settings or (), "rasterizer": rasterizer, "device": device,
            "resume": resume, "overwrite": overwrite, "allow_faults": allow_faults,
            "evaluate": evaluate, "chunk": chunk, "plugins": plugin or (), "view": view,
            "port": port,
            "on_start": show.started, "on_step": show.step,
            "progress": show.fraction, "report": show.line,
        }  # fmt: skip
        if auto:
            named = _clip_for_auto(clip, reader, reader_set, budget)
            made = train_auto(named, spec, on_found=print_needs, **given)
            run = made.run
        else:
            run = train_spec(
                clip, spec, reader=reader, reader_settings=reader_set or (), budget=budget, **given
            )
    if auto:
        _print_after(made.after)
    if run.evaluated is not None:
        print_scores(run.evaluated)


def _clip_for_auto(
    clip: str | None, reader: str | None, reader_set: list[str] | None, budget: str | None
) -> str:
    """The clip of `--auto`, which has to be there; --budget and --reader do not go with it."""
    from hoigs.core.errors import HoigsError
    from hoigs.runs.resuming import NO_CLIP

    if clip is None:
        raise HoigsError(f"{NO_CLIP}; without --auto, --resume takes the run's own")
    if budget is not None:
        raise HoigsError("--auto has a budget of its own: leave --budget out")
    if reader or reader_set:
        raise HoigsError(
            "--auto takes no --reader and no --reader-set: it chooses the reader of CLIP"
        )
    return clip


def _print_after(after: After) -> None:
    """The result of pruning and compression."""
    from hoigs.studies.needs.after_training import sentences, table

    columns, rows = table(after)
    print_table("after the training", columns, rows)
    for sentence in sentences(after):
        typer.echo(sentence)
