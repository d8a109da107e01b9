"""`hoigs export`: a trained run to files that other programs read."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hoigs.cli.common import ClipOption, DeviceOption, PluginOption
from hoigs.cli.display import Display


def export(
    run: Annotated[Path, typer.Argument(help="Run folder.")],
    format: Annotated[
        str,
        typer.Option(
            "--format", help="Name of an exporter: ply, usd … `hoigs plugins` lists them."
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", help="New file (x.ply) or folder; default RUN/exports/FORMAT."),
    ] = None,
    entities: Annotated[
        list[str] | None,
        typer.Option("--entities", help="Export only this entity. Repeatable."),
    ] = None,
    start: Annotated[
        float | None, typer.Option("--from", help="First frame; may be between two.")
    ] = None,
    end: Annotated[float | None, typer.Option("--to", help="Last frame.")] = None,
    fps: Annotated[
        float | None, typer.Option("--fps", help="Moments a second; default the clip's frames.")
    ] = None,
    slow: Annotated[
        float, typer.Option("--slow", help="Play this many times slower, with moments between.")
    ] = 1.0,
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", help="Set one key of the exporter: up=y. Repeatable."),
    ] = None,
    clip: ClipOption = None,
    device: DeviceOption = "auto",
    plugin: PluginOption = None,
) -> None:
    """Write a run to the files of another program, with a list of what was kept and lost."""
    from hoigs.workflows.export import export as write

    with Display() as show:
        done = write(
            run,
            format=format,
            out=out,
            entities=entities or (),
            start=start,
            end=end,
            fps=fps,
            slow=slow,
            overrides=overrides or (),
            clip=clip,
            device=device,
            plugins=plugin or (),
            progress=show.fraction,
        )
    typer.echo(str(done))
