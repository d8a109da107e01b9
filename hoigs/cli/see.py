"""The verbs that show a run or take it away: `hoigs view`, `render`, `export` and `publish`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hoigs.cli.common import ClipOption, DeviceOption, Display, PluginOption, RasterizerOption


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


# `hoigs render`: a trained run as a video, from the clip's cameras or along another path.


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


# `hoigs export`: a trained run to files that other programs read.


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
    from hoigs.viewing.export import export as write

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


# `hoigs publish`: write a folder to object storage.


def publish(
    folder: Annotated[Path, typer.Argument(help="A run, a clip or any other folder.")],
    url: Annotated[str, typer.Argument(help="Where to write it: s3://bucket/results/a.")],
    only: Annotated[
        list[str] | None,
        typer.Option(
            "--only", help="A file or folder directly in it, in place of all. Repeatable."
        ),
    ] = None,
) -> None:
    """Upload a folder; complete.json, with the checksums of its files, is written last."""
    from hoigs.core.system.urls import publish as write

    count = write(folder, url, only=only or ())
    typer.echo(f"{count} files and complete.json: {url}")
