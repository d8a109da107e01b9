"""The verbs that show a run or take it away: `hoigs view`, `render`, `export` and `publish`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hoigs.cli.common import Display, say
from hoigs.cli.options import flags
from hoigs.viewing.options import ExportOptions, RenderOptions, ViewOptions


@flags(ViewOptions)
def view(
    what: Annotated[
        str, typer.Argument(metavar="RUN|CLIP", help="Run folder, clip folder or builtin:NAME.")
    ],
    second: Annotated[
        Path | None, typer.Argument(metavar="[RUN2]", help="Another run, with the same clock.")
    ] = None,
    *,
    options: ViewOptions,
) -> None:
    """Look at a run from any side while it moves; of one in training, at its checkpoints."""
    doing = "starting the viewer" if options.html is None else f"writing {options.html}, a player"
    say(f"{doing} of {' and '.join(str(w) for w in (what, second) if w)} …")
    from hoigs.viewing.view import view as show

    with Display() as display:
        page = show(what, second, options=options, report=display.line, progress=display.fraction)
    if page is not None:
        typer.echo(str(page))


@flags(RenderOptions)
def render(
    run: Annotated[Path, typer.Argument(help="Run folder.")], *, options: RenderOptions
) -> None:
    """Make a film of a run: from the video's camera, around the person, or with time frozen."""
    from hoigs.viewing.films import render as draw

    with Display() as show:
        film = draw(run, options=options, progress=show.fraction)
    typer.echo(str(film))
    typer.echo(f"video: {film.path}")
    if film.replaced:
        typer.echo("an earlier video of this name was replaced")


@flags(ExportOptions)
def export(
    run: Annotated[Path, typer.Argument(help="Run folder.")], *, options: ExportOptions
) -> None:
    """Write a run to the files of another program, with a list of what was kept and lost."""
    from hoigs.viewing.export import export as write

    with Display() as show:
        done = write(run, options=options, progress=show.fraction)
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
