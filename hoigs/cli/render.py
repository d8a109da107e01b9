"""`hoigs render`: a trained run as a video, from the clip's cameras or along another path."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hoigs.cli.common import ClipOption, DeviceOption, PluginOption, RasterizerOption
from hoigs.cli.display import Display


def render(
    run: Annotated[Path, typer.Argument(help="Run folder.")],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="Video: .mp4, .webm, .mov or .gif; default RUN/renders/PATH.mp4, with --compare "
            "PATH-compare.mp4.",
        ),
    ] = None,
    path: Annotated[
        str,
        typer.Option(
            "--path",
            help="video, orbit, bullet-time, spiral, 'follow human', 'follow object', or a JSON "
            "file of cameras.",
        ),
    ] = "video",
    entities: Annotated[
        list[str] | None, typer.Option("--entities", help="Draw only this entity. Repeatable.")
    ] = None,
    only: Annotated[
        list[str] | None, typer.Option("--only", help="An older name of --entities.", hidden=True)
    ] = None,
    compare: Annotated[
        bool, typer.Option("--compare", help="Draw beside the frame of the video.")
    ] = False,
    background: Annotated[
        str | None,
        typer.Option("--background", help="A colour, an image, or transparent; default black."),
    ] = None,
    width: Annotated[int | None, typer.Option("--width", help="Pixels; even.")] = None,
    height: Annotated[int | None, typer.Option("--height", help="Pixels; even.")] = None,
    start: Annotated[float | None, typer.Option("--from", help="First frame.")] = None,
    end: Annotated[float | None, typer.Option("--to", help="Last frame.")] = None,
    fps: Annotated[
        float | None, typer.Option("--fps", help="Pictures a second; default the clip's.")
    ] = None,
    slow: Annotated[
        float, typer.Option("--slow", help="Play this many times slower, with moments between.")
    ] = 1.0,
    at: Annotated[
        float | None,
        typer.Option("--at", help="Frame at which bullet-time stands still; default: the fastest."),
    ] = None,
    clip: ClipOption = None,
    rasterizer: RasterizerOption = None,
    device: DeviceOption = "auto",
    plugin: PluginOption = None,
) -> None:
    """Render a run to a video, and print the frame rate."""
    from hoigs.viewing.films import render as draw

    with Display() as show:
        film = draw(
            run,
            out=out,
            path=path,
            entities=entities or (),
            only=only or (),
            compare=compare,
            background=background,
            width=width,
            height=height,
            start=start,
            end=end,
            fps=fps,
            slow=slow,
            at=at,
            clip=clip,
            rasterizer=rasterizer,
            device=device,
            plugins=plugin or (),
            progress=show.fraction,
        )
    typer.echo(str(film))
    typer.echo(f"video: {film.path}")
    if film.replaced:
        typer.echo("an earlier video of this name was replaced")
