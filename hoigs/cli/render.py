"""`hoigs render`: a trained run as a video, from the clip's cameras or an orbit."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from hoigs.cli.common import ClipOption, DeviceOption, PluginOption, RasterizerOption
from hoigs.cli.display import Display

if TYPE_CHECKING:
    from hoigs.viewing.films import CameraPath


class PathOption(StrEnum):
    playback = "playback"
    orbit = "orbit"


def render(
    run: Annotated[Path, typer.Argument(help="Run folder.")],
    out: Annotated[Path | None, typer.Option("--out", help="Video; default RUN/renders/.")] = None,
    path: Annotated[
        PathOption,
        typer.Option("--path", help="The clip's own cameras, or an orbit around it."),
    ] = PathOption.playback,
    only: Annotated[
        list[str] | None, typer.Option("--only", help="Render only this entity. Repeatable.")
    ] = None,
    clip: ClipOption = None,
    rasterizer: RasterizerOption = None,
    device: DeviceOption = "auto",
    plugin: PluginOption = None,
) -> None:
    """Render a run to an mp4, and print the frame rate."""
    from hoigs.viewing.films import render as draw

    with Display() as show:
        film = draw(
            run,
            out=out,
            path=cast("CameraPath", path.value),
            only=only or (),
            clip=clip,
            rasterizer=rasterizer,
            device=device,
            plugins=plugin or (),
            progress=show.fraction,
        )
    typer.echo(str(film))
    typer.echo(f"video: {film.path}")
