"""`hoigs view`: a run, two runs or a clip in the browser, or a run as one HTML file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hoigs.cli.common import DeviceOption, PluginOption, RasterizerOption
from hoigs.cli.display import Display


def view(
    what: Annotated[
        str, typer.Argument(metavar="RUN|CLIP", help="Run folder, clip folder or builtin:NAME.")
    ],
    second: Annotated[
        Path | None, typer.Argument(metavar="[RUN2]", help="Another run, with the same clock.")
    ] = None,
    host: Annotated[
        str, typer.Option("--host", help="Address to listen on; by default this machine alone.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", help="0 finds a free one.")] = 8090,
    html: Annotated[
        Path | None,
        typer.Option("--html", help="Write one file that plays the run without a server."),
    ] = None,
    max_mb: Annotated[
        float | None,
        typer.Option(
            "--max-mb",
            min=0.1,
            help="Largest size of the file of --html, in megabytes: it then has fewer frames of "
            "what moves, and if need be fewer Gaussians.",
        ),
    ] = None,
    entities: Annotated[
        list[str] | None,
        typer.Option("--entities", help="Write only this entity with --html. Repeatable."),
    ] = None,
    width: Annotated[
        int, typer.Option("--width", min=64, help="Pixels of a still picture at most.")
    ] = 1280,
    client: Annotated[
        bool, typer.Option("--client", help="Send the Gaussians to the browser, which draws them.")
    ] = False,
    clip: Annotated[Path | None, typer.Option("--clip", help="The clip, if it was moved.")] = None,
    rasterizer: RasterizerOption = None,
    device: DeviceOption = "auto",
    plugin: PluginOption = None,
) -> None:
    """Look at a run from any side while it moves; of one in training, at its checkpoints."""
    from hoigs.viewing.view import view as show

    with Display() as display:
        page = show(
            what,
            second,
            host=host,
            port=port,
            html=html,
            max_mb=max_mb,
            entities=entities or (),
            width=width,
            client=client,
            clip=clip,
            rasterizer=rasterizer,
            device=device,
            plugins=plugin or (),
            report=display.line,
            progress=display.fraction,
        )
    if page is not None:
        typer.echo(str(page))
