"""Options of `hoigs view`, `render` and `export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from hoigs.core.options import Flag
from hoigs.runs.options import RunOptions


class ViewOptions(RunOptions):
    """How a run or a clip is shown in the browser."""

    host: str = "127.0.0.1"
    """Address to listen on; by default this machine alone. There is no password."""
    port: int = 8090
    """Port to listen on; 0 finds a free one."""
    html: Path | str | None = None
    """Write one file that plays the run without a server."""
    max_mb: Annotated[float, Field(ge=0.1)] | None = None
    """Largest size of the file of --html, in megabytes: colours then do not change with the
    direction, and if need be it has fewer Gaussians."""
    entities: tuple[str, ...] = ()
    """Write only this entity with --html."""
    width: Annotated[int, Field(ge=64)] = 1280
    """Pixels of a still picture at most."""


class PlayedOptions(RunOptions):
    """Which moments of a run are drawn or written."""

    start: Annotated[float | None, Flag("--from")] = None
    """First frame; may be between two. Default: the clip's first."""
    end: Annotated[float | None, Flag("--to")] = None
    """Last frame. Default: the clip's last."""
    fps: float | None = None
    """Moments a second; default: the clip's frames."""
    slow: float = 1.0
    """Play this many times slower, with moments between frames computed by the model."""


class RenderOptions(PlayedOptions):
    """How a run is drawn to a video."""

    out: Path | str | None = None
    """Video: .mp4, .webm, .mov (ProRes 4444) or .gif; default: RUN/renders/PATH.mp4, with --compare
    PATH-compare.mp4."""
    path: str = "video"
    """The camera: video (the clip's), orbit (around, while the clip plays), bullet-time (around one
    moment), spiral (circles before the middle camera), 'follow human', 'follow object', or a JSON
    file of keyed cameras, also nerfstudio's camera_path.json."""
    entities: tuple[str, ...] = ()
    """Draw only this entity."""
    compare: bool = False
    """Draw beside the frame of the video."""
    background: str | None = None
    """A colour (white, #20242a), an image file, or transparent; default: black."""
    width: int | None = None
    """Pixels, even; default: those of training. One side alone keeps the aspect, both cut what does
    not fit."""
    height: int | None = None
    """Pixels, even."""
    fps: float | None = None
    """Pictures a second; default: those of nerfstudio's file, or the clip's."""
    at: float | None = None
    """Frame at which bullet-time stands still; default: where the objects move fastest."""


class ExportOptions(PlayedOptions):
    """What is written of a run for another program."""

    format: str
    """ply, gltf-4d, bvh …: `hoigs export --help` lists all formats."""
    out: Path | str | None = None
    """New file (x.ply, with x.ply.json beside it), or folder, or x.zip with the folder; default:
    RUN/exports/FORMAT."""
    entities: tuple[str, ...] = ()
    """Export only this entity."""
    overrides: Annotated[tuple[str, ...], Flag("--set")] = ()
    """Set one key of the exporter: up=y."""
