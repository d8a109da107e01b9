"""`hoigs render`: a trained run as a video, from the clip's cameras or an orbit."""

from __future__ import annotations

from collections.abc import Iterator
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from hoigs.cli.common import (
    DeviceOption,
    PluginOption,
    RasterizerOption,
    pick_device,
    progress_bar,
)


class CameraPath(StrEnum):
    playback = "playback"
    orbit = "orbit"


def render(
    run: Annotated[Path, typer.Argument(help="Run folder.")],
    out: Annotated[Path | None, typer.Option("--out", help="Video; default RUN/renders/.")] = None,
    path: Annotated[
        CameraPath,
        typer.Option("--path", help="The clip's own cameras, or an orbit while it plays."),
    ] = CameraPath.playback,
    only: Annotated[
        list[str] | None, typer.Option("--only", help="Draw just this entity. Repeatable.")
    ] = None,
    clip: Annotated[Path | None, typer.Option("--clip", help="The clip, if it has moved.")] = None,
    rasterizer: RasterizerOption = None,
    device: DeviceOption = "auto",
    plugin: PluginOption = None,
) -> None:
    """Draw a run to an mp4."""
    import numpy as np
    import torch

    from hoigs.core.errors import HoigsError, did_you_mean
    from hoigs.evaluation.orbits import orbit_cameras
    from hoigs.evaluation.video import write_video
    from hoigs.training.session import LoadedRun

    loaded = LoadedRun.open(
        run,
        clip=clip,
        rasterizer=rasterizer,
        device=pick_device(device),
        plugins=plugin or (),
    )
    model, source = loaded.model, loaded.clip
    for name in only or []:
        if name not in model.entities:
            known = list(model.entities)
            raise HoigsError(f"--only {name}: this run has {known}{did_you_mean(name, known)}")
    if path is CameraPath.orbit:
        cameras = orbit_cameras(source, model, len(source))
    else:
        cameras = list(source.cameras)
    target = out or run / "renders" / f"{path.value}.mp4"

    def frames() -> Iterator[np.ndarray]:
        with progress_bar("rendering", len(source)) as bar:
            for i, (moment, camera) in enumerate(zip(source.moments, cameras, strict=True)):
                color = model.render(
                    moment.to(model.device), camera.to(model.device), only=only
                ).color
                bar.update(i + 1)
                yield (color.clamp(0, 1) * 255).round().byte().cpu().numpy().astype(np.uint8)

    with torch.no_grad():
        write_video(target, frames(), fps=source.fps)
    typer.echo(f"video: {target}")
