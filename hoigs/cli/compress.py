"""`hoigs compress`: a run in few bytes, and what that costs in the picture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hoigs.cli.common import DeviceOption, PluginOption, pick_device


def compress(
    run: Annotated[Path, typer.Argument(help="Run folder, as `hoigs train` makes it.")],
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder of the small run; default RUN-compact.")
    ] = None,
    clip: Annotated[
        Path | None, typer.Option("--clip", help="The clip, if it has moved; builtin:NAME too.")
    ] = None,
    device: DeviceOption = "auto",
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the run in --out.")
    ] = False,
    plugin: PluginOption = None,
) -> None:
    """Quantise a trained model to 8 and 16 bits a number and squeeze it. eval, render and view take
    the small run as any other; training cannot go on from it."""
    from hoigs.studies.needs.compact_run import compact_run

    target = out or run.with_name(f"{run.name}-compact")
    done = compact_run(
        run,
        target,
        clip=clip,
        device=pick_device(device),
        plugins=plugin or (),
        overwrite=overwrite,
    )
    typer.echo(str(done))
    frames = ", ".join(map(str, done.frames))
    typer.echo(f"looked at: training frames {frames}; people and things, and background, apart")
    typer.echo(f"run: {target}")
