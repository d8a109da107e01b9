"""One frame of a video or of a folder, converted to RGB or grey at a size on request."""

from __future__ import annotations

from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import Bool, UInt8
from PIL import Image
from scipy import ndimage

from hoigs.core.system.images import eight_bits
from hoigs.preparation.video.colors import converted
from hoigs.preparation.video.source import SourceError

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
