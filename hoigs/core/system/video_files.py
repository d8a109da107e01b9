"""Video files: frames in, mp4, webm, mov or gif out, whole or not at all."""

from __future__ import annotations

import itertools
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from torch import Tensor

from hoigs.core.errors import HoigsError

SUFFIXES = (".mp4", ".webm", ".mov", ".gif")
WITH_ALPHA = (".webm", ".mov", ".gif")
FORMATS = {".mp4": "mp4", ".webm": "webm", ".mov": "mov"}
# encoder, pixel format of RGB, pixel format of RGBA, options
ENCODERS: dict[str, tuple[str, str, str, dict[str, str]]] = {
    ".mp4": ("libx264", "yuv420p", "", {"crf": "18", "preset": "medium"}),
    ".webm": (
        "libvpx-vp9", "yuv420p", "yuva420p",
        {"crf": "24", "b:v": "0", "auto-alt-ref": "0", "cpu-used": "4", "row-mt": "0"},
    ),
    ".mov": ("prores_ks", "yuv444p10le", "yuva444p10le", {"profile": "4444", "vendor": "apl0"}),
}  # fmt: skip
BLOCK = 32  # pixels
BT709, SRGB = 1, 13  # primaries and transfer function, as ITU-T H.273 numbers them


def pyav() -> Any:
    """PyAV, which only those need who read or write videos.

    Raises:
        HoigsError: it is not installed.
    """
    try:
        import av
    except ImportError as error:
        raise HoigsError(
            f"videos are read and written by PyAV ({error}): pip install 'hoigs[prepare]' (a .gif "
            "is written without it)"
        ) from error
    return av


def write_video(
    path: Path | str, frames: Iterable[UInt8[np.ndarray, "H W C"]], *, fps: float = 30.0
) -> Path:
    """Encode RGB or RGBA frames, under a temporary name until complete.

    mp4 is H.264, webm VP9, mov ProRes 4444 and gif as it is; all but mp4 hold alpha (straight).
    Odd sizes lose their last row or column, as the formats need even ones, except in gif.

    Raises:
        ValueError: there are no frames, or their sizes differ.
        HoigsError: another suffix, or frames with alpha for an mp4.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in SUFFIXES:
        raise HoigsError(f"{path}: videos end with {', '.join(SUFFIXES)}")
    made = not path.parent.exists()
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.part")
    checked = _checked(frames, even=kind != ".gif")
    try:
        first = next(checked, None)
        if first is None:
            raise ValueError("a video needs at least one frame")
        if first.shape[2] == 4 and kind not in WITH_ALPHA:
            raise HoigsError(f"{path}: {kind} holds no alpha; write {', '.join(WITH_ALPHA)}")
        (_write_gif if kind == ".gif" else _encode)(
            temporary, kind, itertools.chain((first,), checked), first, fps
        )
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        if made:
            path.parent.rmdir()
        raise
    return path


def _checked(frames: Iterable[np.ndarray], *, even: bool) -> Iterator[np.ndarray]:
    """Frames of one size, cut to even sides."""
    size = None
    for i, frame in enumerate(frames):
        if even:
            frame = frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2]
        size = size or frame.shape
        if frame.shape != size:
            raise ValueError(
                f"frame {i} is {frame.shape[1]}x{frame.shape[0]}, the first was {size[1]}x{size[0]}"
            )
        yield np.ascontiguousarray(frame)


def _encode(
    path: Path, kind: str, frames: Iterator[np.ndarray], first: np.ndarray, fps: float
) -> None:
    av = pyav()
    name, rgb, rgba, options = ENCODERS[kind]
    alpha = first.shape[2] == 4
    # without a date and a version in the file, the same frames give the same bytes
    flags = {"fflags": "+bitexact"}
    with av.open(str(path), "w", format=FORMATS[kind], options=flags) as container:
        stream: Any = container.add_stream(name, rate=Fraction(fps).limit_denominator(1001))
        stream.pix_fmt, stream.options = (rgba if alpha else rgb), options
        stream.height, stream.width = first.shape[:2]
        if kind != ".mp4":  # these encoders' bytes depend on the number of threads
            stream.codec_context.thread_count = 1
        declare_colors(stream)
        for frame in frames:
            container.mux(stream.encode(coded(frame, stream)))
        container.mux(stream.encode())


def declare_colors(stream: Any) -> None:
    """Write into a video which colours `coded` gives: players guess what is not declared, and are
    wrong by up to 25 of 255."""
    from av.video.reformatter import ColorRange, Colorspace

    context = stream.codec_context
    context.colorspace, context.color_range = Colorspace.ITU709, ColorRange.MPEG
    context.color_primaries, context.color_trc = BT709, SRGB


def coded(image: UInt8[np.ndarray, "H W C"], stream: Any) -> Any:
    """An RGB or RGBA picture as PyAV's frame for a stream, by the matrix of BT.709.

    The conversion and encoders read on to the end of a block of pixels, where a row's memory holds
    whatever was there: rows are continued by their last pixel, so that equal pictures give equal
    files.
    """
    av = pyav()
    from av.video.reformatter import ColorRange, Colorspace

    height, width = image.shape[:2]
    wide = np.pad(image, ((0, 0), (0, -width % BLOCK), (0, 0)), "edge")
    frame = av.VideoFrame.from_ndarray(wide, format="rgba" if image.shape[2] == 4 else "rgb24")
    frame = frame.reformat(
        format=stream.pix_fmt, src_color_range=ColorRange.JPEG,
        dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG,
    )  # fmt: skip
    made = av.VideoFrame(width, height, stream.pix_fmt)
    made.colorspace, made.color_range = Colorspace.ITU709, ColorRange.MPEG
    kind = np.dtype(np.uint16 if made.format.components[0].bits > 8 else np.uint8)
    planes: Any = zip(frame.planes, made.planes, strict=True)
    for source, plane in planes:
        given = np.frombuffer(source, kind).reshape(source.height, -1)[:, : source.width]
        room = plane.line_size // kind.itemsize
        rows = np.pad(given[:, :room], ((0, 0), (0, max(0, room - source.width))), "edge")
        plane.update(rows)
    return made


def _write_gif(
    path: Path, kind: str, frames: Iterator[np.ndarray], first: np.ndarray, fps: float
) -> None:
    """One palette for all frames, from the first one and a few that follow, dithered."""
    from PIL import Image

    del kind
    images = [Image.fromarray(frame) for frame in frames]
    duration = max(20, round(100 / fps) * 10)  # gif counts hundredths; browsers slow shorter ones
    if first.shape[2] == 3:
        some = images[:: max(1, len(images) // 6)]
        sheet = Image.fromarray(np.concatenate([np.asarray(i) for i in some]))
        palette = sheet.quantize(255, dither=Image.Dither.NONE)
        images = [i.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG) for i in images]
    images[0].save(
        path, format="GIF", save_all=True, append_images=images[1:], duration=duration, loop=0,
        optimize=False, disposal=2 if first.shape[2] == 4 else 1,
    )  # fmt: skip


# PixelCache: decoded frames within a budget of memory.


class PixelCache:
    """The last used tensors, up to a budget; the least recently used go first.

    Safe to use from several threads: loading happens outside the lock.

    Args:
        cache_mb: MiB; 0 keeps nothing.

    Attributes:
        cached_bytes: kept now.
    """

    def __init__(self, cache_mb: int) -> None:
        self.budget = cache_mb * 2**20
        self.cached_bytes = 0
        self._kept: OrderedDict[Hashable, Tensor] = OrderedDict()
        self._lock = threading.Lock()

    def __getstate__(self) -> dict[str, Any]:
        """Copies and pickles have the budget only: pixels are decoded again where they are read."""
        return {"budget": self.budget}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(0)  # type: ignore[misc]  # makes an empty cache and a lock
        self.budget = state["budget"]

    def get(self, key: Hashable, load: Callable[[], Tensor]) -> Tensor:
        """What is kept under `key`, or what `load` returns."""
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key]
        value = load()
        size = value.element_size() * value.numel()
        with self._lock:
            if key not in self._kept and size <= self.budget:
                self._kept[key] = value
                self.cached_bytes += size
            while self.cached_bytes > self.budget:
                _, old = self._kept.popitem(last=False)
                self.cached_bytes -= old.element_size() * old.numel()
        return value
