"""One frame of a video or of a folder, converted to RGB or grey at a size on request."""

from __future__ import annotations

import itertools
import threading
from fractions import Fraction
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import Bool, UInt8
from PIL import Image
from scipy import ndimage

from hoigs.core.system.images import eight_bits
from hoigs.core.system.video_files import pyav
from hoigs.preparation.video.source import SourceError

# numbers are those of ITU-T H.273
CONVERTED = {8: "linear light", 9: "logarithmic light", 10: "logarithmic light", 16: "PQ (HDR)",
             17: "SMPTE 428", 18: "HLG (HDR)"}  # fmt: skip
WIDE = {4: "BT.470 M", 8: "film", 9: "BT.2020", 10: "XYZ", 11: "DCI P3", 12: "Display P3"}
MATRICES = {8: "YCgCo", 10: "BT.2020 of constant luminance", 11: "SMPTE 2085",
            12: "derived from primaries", 13: "derived from primaries, of constant luminance",
            14: "ICtCp", 15: "IPT-C2 (Dolby Vision)", 16: "YCgCo-Re", 17: "YCgCo-Ro"}  # fmt: skip
GRAPHS = 12  # that are kept: a few sizes of one or two videos


def converted(frame: Any, width: int, height: int, form: str = "rgb24") -> Any:
    """A decoded frame (PyAV's) at a size in pixels, as `rgb24` or `gray`; grey is brightness as
    coded, to compare frames by.

    Raises:
        SourceError: its colours cannot be converted; it names their matrix, curve and primaries.
    """
    av = pyav()

    for tag in ("colorspace", "color_trc", "color_primaries"):  # reserved: nothing is known
        if int(getattr(frame, tag)) == 3 or (int(getattr(frame, tag)) == 0 and tag != "colorspace"):
            setattr(frame, tag, 2)
    curve, primaries = int(frame.color_trc), int(frame.color_primaries)
    try:
        if form == "rgb24" and (curve in CONVERTED or primaries in WIDE):
            # at the frame's own size: the table of the conversion takes seconds to make, once
            to_curve = "iec61966-2-1" if curve in CONVERTED else ""
            frame = _through(frame, frame.width, frame.height, "rgb48", to_curve)
        return _through(frame, width, height, form)
    except av.error.FFmpegError as error:
        raise SourceError(
            f"the video's colours cannot be converted ({_named(frame)}): {error}; convert it to "
            "BT.709 by the program that made it, or with `ffmpeg -i VIDEO -vf "
            "libplacebo=colorspace=bt709:color_primaries=bt709:color_trc=bt709 fixed.mp4`"
        ) from error


def _named(frame: Any) -> str:
    matrix, curve, primaries = (
        int(n) for n in (frame.colorspace, frame.color_trc, frame.color_primaries)
    )
    return (
        f"{frame.format.name}, matrix {MATRICES.get(matrix, matrix)}, curve "
        f"{CONVERTED.get(curve, curve)}, primaries {WIDE.get(primaries, primaries)}"
    )


def _through(frame: Any, width: int, height: int, form: str, to_curve: str | None = None) -> Any:
    shrinks = width < frame.width or height < frame.height
    options = f"w={width}:h={height}:flags={'area' if shrinks else 'bicubic'}"
    options += "+accurate_rnd+full_chroma_int"  # swscale is else up to 2 of 255 off
    if to_curve is not None:
        options += ":out_primaries=bt709" + (f":out_transfer={to_curve}" if to_curve else "")
    tags = tuple(int(n) for n in (frame.colorspace, frame.color_range))
    # the filter keeps what it made for a curve and primaries, and makes it anew when they change
    light = tuple(int(n) for n in (frame.color_trc, frame.color_primaries))
    size = (frame.width, frame.height)
    return _graph(frame.format.name, size, tags, light, options, form).run(frame)


class _Graph:
    """FFmpeg's filters from frames of one kind to another; threads take turns."""

    def __init__(self, chain: list[tuple[str, str]]) -> None:
        from av.filter import Graph

        self._lock, self._graph = threading.Lock(), Graph()
        nodes = [self._graph.add(name, options) for name, options in chain]
        for first, second in itertools.pairwise(nodes):
            first.link_to(second)
        self._graph.configure()

    def run(self, frame: Any) -> Any:
        with self._lock:
            self._graph.push(frame)
            return self._graph.pull()


@lru_cache(maxsize=GRAPHS)
def _graph(
    pixels: str,
    size: tuple[int, int],
    tags: tuple[int, int],
    light: tuple[int, int],
    options: str,
    form: str,
) -> _Graph:
    del light
    buffer = f"video_size={size[0]}x{size[1]}:pix_fmt={pixels}:time_base=1/1000"
    buffer += f":colorspace={tags[0]}:range={tags[1]}"
    return _Graph(
        [
            ("buffer", buffer),
            # HDR10+ gives each frame a curve of its own; a scene must not change from frame to
            # frame
            ("sidedata", "mode=delete:type=DYNAMIC_HDR_PLUS"),
            ("scale", options),
            ("format", form),
            ("buffersink", ""),
        ]
    )


LARGEST_ASPECT = 10  # of a pixel; what is recorded is from 1/3 to 4


class Picture(Protocol):
    """One frame of a source, not yet converted.

    Attributes:
        seconds: when it is shown, by the source's clock; None where it has none.
    """

    seconds: float | None

    def size(self) -> tuple[int, int]:
        """Width and height, upright."""

    def rgb(self, width: int, height: int) -> UInt8[np.ndarray, "H W 3"]:
        """Pixels at a size."""

    def grey(self, width: int) -> UInt8[np.ndarray, "h w"]:
        """Brightness at about this width, however turned."""


class VideoPicture:
    """A decoded frame, as players show it: upright, with square pixels, in 8-bit sRGB.

    Args:
        frame: PyAV's. aspect: width of a pixel over its height, as stored; None: square.

    Raises:
        SourceError: the aspect is no picture's; by `rgb` and `grey`, if its colours cannot be
            converted.
    """

    def __init__(self, frame: Any, aspect: Fraction | None = None) -> None:
        self.frame, self.orientation = frame, orientation(frame)
        self.seconds: float | None = frame.time
        if aspect and not 1 / LARGEST_ASPECT <= aspect <= LARGEST_ASPECT:
            raise SourceError(
                f"the video's pixels are {aspect.numerator}:{aspect.denominator} as wide as high "
                f"(sample aspect ratio), more than {LARGEST_ASPECT} to 1; mend it, such as with "
                "`ffmpeg -i VIDEO -vf setsar=1 fixed.mp4`"
            )
        # the shorter side of a pixel grows: nothing is lost
        wide, high = max(aspect or 1, 1), max(1 / aspect if aspect else 1, 1)
        self._shown = max(1, round(frame.width * wide)), max(1, round(frame.height * high))

    def size(self) -> tuple[int, int]:
        return self._shown[::-1] if self.orientation[0] else self._shown

    def rgb(self, width: int, height: int) -> UInt8[np.ndarray, "H W 3"]:
        swapped, down, right = self.orientation
        if swapped:
            width, height = height, width
        pixels = converted(self.frame, width, height).to_ndarray()
        if swapped:
            pixels = pixels.transpose(1, 0, 2)
        return np.ascontiguousarray(pixels[::down, ::right])

    def grey(self, width: int) -> UInt8[np.ndarray, "h w"]:
        width = min(width, self._shown[0])
        height = max(1, round(self._shown[1] * width / self._shown[0]))
        return converted(self.frame, width, height, "gray").to_ndarray()


class FilePicture:
    """An image file, opened when its pixels are read."""

    seconds: float | None = None

    def __init__(self, path: Path) -> None:
        self.path = path

    @cached_property
    def image(self):
        from PIL import Image, ImageOps

        try:
            with Image.open(self.path) as image:
                return eight_bits(ImageOps.exif_transpose(image)).convert("RGB")
        except (OSError, ValueError) as error:
            raise SourceError(f"{self.path} is not a readable image: {error}") from error

    def size(self) -> tuple[int, int]:
        return self.image.size

    def rgb(self, width: int, height: int) -> UInt8[np.ndarray, "H W 3"]:
        from PIL import Image

        image = self.image
        if image.size != (width, height):
            image = image.resize((width, height), Image.Resampling.BOX)
        return np.array(image)

    def grey(self, width: int) -> UInt8[np.ndarray, "h w"]:
        from PIL import Image

        image = self.image.convert("L")
        width = min(width, image.width)
        height = max(1, round(image.height * width / image.width))
        return np.array(image.resize((width, height), Image.Resampling.BOX))


def orientation(frame: Any) -> tuple[bool, int, int]:
    """How a frame is set upright, which phones store apart: whether rows and columns are swapped,
    then steps, 1 or -1, along rows and along columns."""
    matrix = frame.side_data.get("DISPLAYMATRIX")
    if matrix is None:
        return False, 1, 1
    a, b, _, c, d = np.frombuffer(bytes(matrix), np.int32)[
        :5
    ].tolist()  # (x, y) to ax + cy, bx + dy
    if abs(a) + abs(d) >= abs(b) + abs(c):
        return False, -1 if d < 0 else 1, -1 if a < 0 else 1
    return True, -1 if b < 0 else 1, -1 if c < 0 else 1


# Images and masks at another size.


def shrink(
    image: UInt8[np.ndarray, "H W 3"], width: int, height: int
) -> UInt8[np.ndarray, "h w 3"]:
    """The image at another size, area-averaged."""
    if (width, height) == image.shape[1::-1]:
        return image
    return np.array(Image.fromarray(image).resize((width, height), Image.Resampling.BOX))


def shrink_mask(mask: Bool[np.ndarray, "H W"], width: int, height: int) -> Bool[np.ndarray, "h w"]:
    """The mask at another size, by nearest pixel."""
    if (width, height) == mask.shape[1::-1]:
        return mask
    grey = Image.fromarray(mask.astype(np.uint8) * 255)
    return np.array(grey.resize((width, height), Image.Resampling.NEAREST)) > 127


def resized_mask(mask: Bool[np.ndarray, "H W"], size: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """The mask at another (width, height): pixels of which it covers half."""
    if mask.shape[::-1] == size:
        return mask
    grey = Image.fromarray(mask.astype(np.uint8) * 255)
    return np.asarray(grey.resize(size, Image.Resampling.BOX)) > 127


# How sharp a frame is, compared with its neighbours.

WIDTH = 640  # at which frames are compared: motion blur that matters shows there


class Grey(Protocol):
    """A picture that gives its brightness at a width."""

    def grey(self, width: int) -> UInt8[np.ndarray, "h w"]: ...


def sharpness(picture: Grey) -> float:
    """Standard deviation of the Laplacian over that of the brightness, at a width of 640.

    The variance of the Laplacian (Pech-Pacheco et al. 2000), divided by the contrast so that a
    change of exposure is not taken for blur. It compares frames of one scene; between scenes it
    means nothing. 0 for a frame of one colour.
    """
    grey = picture.grey(WIDTH).astype(np.float32)
    contrast = float(grey.std())
    return float(ndimage.laplace(grey).std()) / contrast if contrast > 0 else 0.0
