"""render: a trained run as a film, drawn by `Playback`."""

from __future__ import annotations

import base64
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageColor, ImageOps, UnidentifiedImageError
from torch import Tensor

from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.interfaces.rasterizer import RenderOutput, RenderRequest
from hoigs.core.model.scene import SceneModel
from hoigs.core.options import verb
from hoigs.core.parameters import PIECE, release_time_rows
from hoigs.core.reporting import Progress, default_progress
from hoigs.core.system.threads import short_waits_when_busy
from hoigs.core.system.video_files import ENCODERS, SUFFIXES, WITH_ALPHA, pyav, write_video
from hoigs.core.values.between import frame_numbers
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip
from hoigs.runs.loaded_run import LoadedRun
from hoigs.viewing.options import RenderOptions
from hoigs.viewing.paths import View, film_path, frames_shown, rate_of
from hoigs.viewing.playback import Mode, Playback
from hoigs.viewing.viewer.panes import nearest_position, placed

# Pictures of films: size, background, dithering, and the video beside them.

LARGEST = 8192  # pixels of a side


def dithered(color: Float[Tensor, "H W C"], index: int = 0) -> UInt8[np.ndarray, "H W C"]:
    """Colours in [0, 1] at 8 bits, with noise in place of steps, so that gradients show no bands.

    The noise is interleaved gradient noise (Jimenez 2014), another for each picture `index`; the
    mean over a few pixels or pictures is the colour, and none is more than one step away.
    """
    height, width = color.shape[:2]
    y, x = np.mgrid[:height, :width] + 5.588238 * (index % 64)
    noise = np.modf(52.9829189 * np.modf(0.06711056 * x + 0.00583715 * y)[0])[0]
    value = color.detach().clamp(0, 1).cpu().numpy().astype(np.float64) * 255
    return np.floor(value + noise[..., None]).clip(0, 255).astype(np.uint8)


def fitted(camera: Camera, width: int | None, height: int | None) -> Camera:
    """The same view at a size: one side alone keeps the aspect, both cut what does not fit.

    Raises:
        HoigsError: a side that is odd, which videos do not take, or out of bounds.
    """
    if width is None and height is None:
        return camera
    for name, side in (("width", width), ("height", height)):
        if side is not None and (side % 2 or not 16 <= side <= LARGEST):
            raise HoigsError(f"{name} {side}: expected an even number from 16 to {LARGEST}")
    aspect = camera.width / camera.height
    wide = width if width is not None else max(16, 2 * round((height or 0) * aspect / 2))
    high = height if height is not None else max(16, 2 * round(wide / aspect / 2))
    scale = max(wide / camera.width, high / camera.height)
    full = round(camera.width * scale), round(camera.height * scale)
    left, top = (max(0, full[0] - wide) // 2, max(0, full[1] - high) // 2)
    return camera.resized(*full).cropped(left, top, wide, high)


def read_background(text: str, camera: Camera) -> Tensor:
    """A colour [3], or an image [H, W, 3] that fills the view, RGB in [0, 1].

    Raises:
        HoigsError: neither a colour nor an image file.
    """
    try:
        return torch.tensor(ImageColor.getrgb(text)[:3]) / 255.0
    except ValueError:
        pass
    path = Path(text)
    if not path.is_file():
        raise HoigsError(
            f'background "{text}": expected a colour ("white", "#20242a"), an image file, or '
            '"transparent"'
        )
    try:
        with Image.open(path) as opened:
            return _filling(np.asarray(opened.convert("RGB")), camera.width, camera.height)
    except (UnidentifiedImageError, OSError) as error:
        raise HoigsError(f"background {path}: not an image: {error}") from error


def source_frame(
    clip: Clip, frame: float, camera: Camera, channels: int, shape: tuple[int, int] | None = None
) -> UInt8[np.ndarray, "H W C"]:
    """The nearest frame of the video, as large as the picture beside it.

    Args:
        shape: width and height into which frames of another size are fitted whole first, as the
            film's cameras were.
    """
    own = clip.store.image(nearest_position(clip, frame)).numpy()
    if shape is not None and shape != (own.shape[1], own.shape[0]):
        own = placed(own, shape)
    image = _filling(own, camera.width, camera.height)
    array: np.ndarray = (image * 255).round().to(torch.uint8).numpy()
    if channels == 4:
        array = np.concatenate((array, np.full_like(array[..., :1], 255)), -1)
    return array


def _filling(image: UInt8[np.ndarray, "h w 3"], width: int, height: int) -> Float[Tensor, "H W 3"]:
    """An image at a size, in [0, 1]; what does not fit is cut at both ends."""
    fit = ImageOps.fit(Image.fromarray(image), (width, height), Image.Resampling.LANCZOS)
    return torch.from_numpy(np.array(fit)).float() / 255.0


VIEWS = 8  # frames of a film, evenly spread, that a Playback is made from
TRANSPARENT = "transparent"


@dataclass(frozen=True)
class Film:
    """A video that was written.

    Attributes:
        path: the video. frames: their number. width, height: pixels of the renders.
        draw_s: seconds of rendering, without preparing Playback and without encoding.
        total_s: seconds of rendering and encoding.
        mode, reason: `Playback.mode` ("graph" if CUDA graphs rendered it) and `Playback.reason`.
        replaced: whether there was an earlier video of this path.
    """

    path: Path
    frames: int
    width: int
    height: int
    draw_s: float
    total_s: float
    mode: Mode
    reason: str
    replaced: bool = False

    def _repr_html_(self) -> str:
        """The film itself, inside the page of a notebook."""
        data, kind = base64.b64encode(self.path.read_bytes()).decode(), self.path.suffix[1:]
        if kind == "gif":
            return f"<img src='data:image/gif;base64,{data}'>"
        return f"<video controls autoplay loop muted src='data:video/{kind};base64,{data}'></video>"

    @property
    def fps(self) -> float:
        """Frames rendered per second, without encoding."""
        return self.frames / self.draw_s

    def __str__(self) -> str:
        without = f"; without CUDA graphs: {self.reason}"
        how = {"graph": "; by CUDA graphs", "cached": ""}.get(self.mode, without)
        return (
            f"{self.frames} frames of {self.width}x{self.height}, {self.fps:.1f} frames/s drawn, "
            f"{self.frames / self.total_s:.1f} with encoding{how}"
        )


@verb(RenderOptions)
@short_waits_when_busy()
def render(run: Path | str, *, options: RenderOptions, progress: Progress | None = None) -> Film:
    """Draw a run to a video.

    Args:
        run: a run folder, as `hoigs.train` makes it.
        progress: called with the share done, in [0, 1], and the work.

    Raises:
        HoigsError: this is no run, its clip is not there, or an entity, a path, a background, a
            size or a kind of file is unknown.
    """
    name = options.path
    target = _target(Path(run), name, options)
    loaded = options.open(run, pixels=options.compare)
    names = list(loaded.model.entities)
    for entity in options.entities:
        if entity not in names:
            raise HoigsError(
                f"--entities {entity}: this run has {', '.join(names)}{did_you_mean(entity, names)}"
            )
    numbers, rate = frame_numbers(
        loaded.clip, options.start, options.end, options.fps, options.slow
    )
    if name.endswith(".json") and options.fps is None:
        rate = rate_of(Path(name)) or rate
    views = film_path(loaded.model, loaded.clip, name, numbers, rate, options.at)
    film = [(moment, fitted(camera, options.width, options.height)) for moment, camera in views]
    several = len({(camera.width, camera.height) for camera in loaded.clip.cameras}) > 1
    shape = (views[0][1].width, views[0][1].height) if several else None
    return _draw(loaded, film, target, rate, shape, options, progress or default_progress())


def _target(run: Path, path: str, options: RenderOptions) -> Path:
    """The video's file; one that cannot hold the video is refused before the drawing."""
    clear = options.background == TRANSPARENT
    if options.out is not None:
        target = Path(options.out)
    else:
        stem = Path(path).stem if path.endswith(".json") else path.replace(" ", "-")
        stem += "-compare" if options.compare else ""
        target = run / "renders" / f"{stem}{'.webm' if clear else '.mp4'}"
    kinds = WITH_ALPHA if clear else SUFFIXES
    if target.suffix.lower() not in kinds:
        what = "transparent videos" if clear else "videos"
        raise HoigsError(f"{target}: {what} end with {', '.join(kinds)}")
    if target.suffix.lower() in ENCODERS:
        pyav()
    return target


def _draw(
    loaded: LoadedRun,
    film: Sequence[View],
    target: Path,
    fps: float,
    shape: tuple[int, int] | None,
    options: RenderOptions,
    report: Progress,
) -> Film:
    camera, clear = film[0][1], options.background == TRANSPARENT
    given = None if clear else options.background
    behind = None if given is None else read_background(given, camera)
    play = playback_of(loaded.model, film, options.entities, behind, copied=False)
    shown = frames_shown(loaded.clip, film) if options.compare else []
    drawn, draw_s = 0, 0.0

    def frames() -> Iterator[UInt8[np.ndarray, "H W C"]]:
        nonlocal drawn, draw_s
        for moment, view in film:
            began = time.perf_counter()
            output = play(moment, view)
            if output.color.is_cuda:
                torch.cuda.synchronize(output.color.device)
            draw_s += time.perf_counter() - began
            picture = dithered(_with_alpha(output) if clear else output.color, drawn)
            if options.compare:
                source = source_frame(loaded.clip, shown[drawn], view, picture.shape[2], shape)
                picture = np.concatenate((source, picture), 1)
            drawn += 1
            report(drawn / len(film), f"frame {drawn} of {len(film)}")
            if drawn % PIECE == 0:
                release_time_rows(loaded.model)
            yield picture

    began, replaced = time.perf_counter(), target.exists()
    try:
        write_video(target, frames(), fps=fps)
    except OSError as error:
        raise HoigsError(f"{target} cannot be written: {error.strerror or error}") from error
    total_s = time.perf_counter() - began
    return Film(
        target, drawn, camera.width, camera.height, draw_s, total_s, play.mode, play.reason,
        replaced,
    )  # fmt: skip


def _with_alpha(output: RenderOutput) -> Float[Tensor, "H W 4"]:
    """Straight colours and opacity of a picture over black."""
    alpha = output.alpha.clamp(0, 1)[..., None]
    return torch.cat((output.color / alpha.clamp_min(1e-3), alpha), -1)


def playback_of(
    model: SceneModel,
    film: Sequence[View],
    only: Sequence[str] = (),
    background: Tensor | None = None,
    copied: bool = True,
) -> Playback:
    """A Playback made from a few frames of a film; an empty `only` draws all entities."""
    some = film[:: max(1, len(film) // VIEWS)]
    request = RenderRequest()
    if background is not None:
        request = replace(request, background=background.to(model.device))
    return Playback(model, some, only=list(only) or None, request=request, copied=copied)
