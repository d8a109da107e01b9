"""`hoigs compress`: quantise the model of a run, and print what that costs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hoigs.cli.common import ClipOption, DeviceOption, OverwriteOption, PluginOption


def compress(
    run: Annotated[Path, typer.Argument(help="Run folder, as `hoigs train` makes it.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder of the compressed run; default RUN-compact."),
    ] = None,
    clip: ClipOption = None,
    device: DeviceOption = "auto",
    overwrite: OverwriteOption = False,
    plugin: PluginOption = None,
) -> None:
    """Quantise a trained model to 8 and 16 bits a number and compress it.

    The result is a run for eval, render and view; it cannot be trained further.
    """
    from hoigs.studies.needs.pruning.compact_run import compress as compress_run

    done = compress_run(
        run, out=out, clip=clip, device=device, overwrite=overwrite, plugins=plugin or ()
    )
    typer.echo(str(done))
    frames = ", ".join(map(str, done.frames))
    typer.echo(f"scored on training frames {frames}: people and objects, and background")
    typer.echo(f"run: {done.path}")
