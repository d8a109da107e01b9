"""render: a trained run as an mp4, drawn by `Playback`."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import UInt8

from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.model.scene import SceneModel
from hoigs.core.progress import Progress, no_progress
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip
from hoigs.core.values.moment import Moment
from hoigs.evaluation.orbits import orbit_cameras
from hoigs.evaluation.report.draw import picture
from hoigs.runs.loaded_run import LoadedRun
from hoigs.viewing.playback import Mode, Playback

CameraPath = Literal["playback", "orbit"]
VIEWS = 8  # frames of a film, evenly spread, that a Playback is made from


@dataclass(frozen=True)
class Film:
    """A video that was written.

    Attributes:
        path: the mp4. frames: their number. width, height: pixels of the renders.
        draw_s: seconds of rendering, without preparing Playback and without encoding.
        total_s: seconds of rendering and encoding.
        mode, reason: `Playback.mode` ("graph" if CUDA graphs rendered it) and `Playback.reason`.
    """

    path: Path
    frames: int
    width: int
    height: int
    draw_s: float
    total_s: float
    mode: Mode
    reason: str

    @property
    def fps(self) -> float:
        """Frames rendered per second, without encoding."""
        return self.frames / self.draw_s

    def __str__(self) -> str:
        how = "by CUDA graphs" if self.mode == "graph" else f"without CUDA graphs: {self.reason}"
        return (
            f"{self.frames} frames of {self.width}x{self.height}, {self.fps:.1f} frames/s drawn, "
            f"{self.frames / self.total_s:.1f} with encoding; {how}"
        )


def render(
    run: Path | str,
    *,
    out: Path | str | None = None,
    path: CameraPath = "playback",
    only: Sequence[str] = (),
    clip: Path | str | None = None,
    rasterizer: str | None = None,
    device: str = "auto",
    plugins: Sequence[Path | str] = (),
    progress: Progress | None = None,
) -> Film:
    """Draw a run to an mp4.

    Args:
        out: the video; by default RUN/renders/PATH.mp4.
        path: "playback" follows the clip's cameras, "orbit" moves around while the clip plays.
        only: names of the entities to draw; all by default.
        clip, rasterizer, device, plugins: as for `open_run`.
        progress: called with the share done, in [0, 1], and the work.

    Raises:
        HoigsError: this is no run, its clip is not there, or an entity or a path is unknown.
    """
    run = Path(run)
    known = get_args(CameraPath)
    if path not in known:
        raise HoigsError(f"path {path!r}: expected one of {known}{did_you_mean(path, known)}")
    loaded = LoadedRun.open(run, clip=clip, rasterizer=rasterizer, device=device, plugins=plugins)
    names = list(loaded.model.entities)
    for name in only:
        if name not in names:
            raise HoigsError(f"only {name!r}: this run has {names}{did_you_mean(name, names)}")
    film = film_views(loaded.model, loaded.clip, path)
    play = playback_of(loaded.model, film, only)
    drawn, draw_s = 0, 0.0
    report = progress or no_progress

    def frames() -> Iterator[UInt8[np.ndarray, "H W 3"]]:
        nonlocal drawn, draw_s
        for moment, camera in film:
            began = time.perf_counter()
            color = play(moment, camera).color
            if color.is_cuda:
                torch.cuda.synchronize(color.device)
            draw_s += time.perf_counter() - began
            drawn += 1
            report(drawn / len(film), "rendering")
            yield picture(color)

    target = Path(out) if out is not None else run / "renders" / f"{path}.mp4"
    began = time.perf_counter()
    write_video(target, frames(), fps=loaded.clip.fps)
    total_s = time.perf_counter() - began
    camera = film[0][1]
    return Film(
        target, drawn, camera.width, camera.height, draw_s, total_s, play.mode, play.reason
    )  # fmt: skip


def film_views(model: SceneModel, clip: Clip, path: CameraPath) -> list[tuple[Moment, Camera]]:
    """The moment and camera of every frame of a film over the whole clip."""
    turned = orbit_cameras(clip, model, len(clip)) if path == "orbit" else list(clip.cameras)
    return list(zip(clip.moments, turned, strict=True))


def playback_of(
    model: SceneModel, film: Sequence[tuple[Moment, Camera]], only: Sequence[str] = ()
) -> Playback:
    """A Playback made from a few frames of a film; an empty `only` draws all entities."""
    some = film[:: max(1, len(film) // VIEWS)]
    return Playback(model, some, only=list(only) or None)


def write_video(
    path: Path | str, frames: Iterable[UInt8[np.ndarray, "H W 3"]], *, fps: float = 30.0
) -> Path:
    """Encode RGB frames as H.264 (yuv420p), under a temporary name until complete.

    Odd sizes lose their last row or column, as the format needs even ones.

    Raises:
        ValueError: there are no frames, or their sizes differ.
    """
    import av

    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.part")
    count = 0
    try:
        with av.open(str(temporary), "w", format="mp4") as container:
            stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
            stream.pix_fmt = "yuv420p"
            stream.options = {"crf": "18", "preset": "medium"}
            for count, frame in enumerate(frames, 1):
                frame = frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2]
                if count == 1:
                    stream.height, stream.width = frame.shape[:2]
                elif frame.shape[:2] != (stream.height, stream.width):
                    raise ValueError(
                        f"frame {count - 1} is {frame.shape[1]}x{frame.shape[0]}, the first was "
                        f"{stream.width}x{stream.height}"
                    )
                image = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
                container.mux(stream.encode(image))
            if count == 0:
                raise ValueError("a video needs at least one frame")
            container.mux(stream.encode())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    return path
