"""`hoigs annotate`: click on people and objects of a video in a local page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def annotate(
    video: Annotated[Path, typer.Argument(help="A video, or a folder with one or with frames.")],
    out: Annotated[
        Path | None, typer.Option("--out", help="Clip to prepare; default: clips/VIDEO'S NAME.")
    ] = None,
    port: Annotated[int, typer.Option("--port", help="0 finds a free one.")] = 8091,
    browser: Annotated[
        bool, typer.Option("--open/--no-open", help="Open the page in the browser.")
    ] = True,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="Any option of prepare: every=2, camera=static. Repeatable."),
    ] = None,
    file: Annotated[
        Path | None, typer.Option("--options", help="YAML or TOML file of prepare's options.")
    ] = None,
) -> None:
    """Click on the people and objects of a video, see their masks, and prepare it."""
    from hoigs.annotation.annotate import annotate as serve

    serve(
        video,
        out,
        port=port,
        overrides=settings or (),
        options=file,
        open_browser=browser,
        report=typer.echo,
    )
