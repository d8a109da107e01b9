"""One frame of a video or of a folder, converted to RGB or grey at a size on request."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np
from jaxtyping import UInt8

from hoigs.preparation.video.source import SourceError


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
    """A decoded frame."""

    def __init__(self, frame) -> None:
        self.frame, self.turns = frame, quarter_turns(frame)
        self.seconds: float | None = frame.time

    def size(self) -> tuple[int, int]:
        size = (self.frame.width, self.frame.height)
        return size[::-1] if self.turns % 2 else size

    def rgb(self, width: int, height: int) -> UInt8[np.ndarray, "H W 3"]:
        frame = self.frame
        if self.turns % 2:
            width, height = height, width
        if (width, height) != (frame.width, frame.height):
            frame = frame.reformat(width=width, height=height, interpolation="AREA")
        pixels = frame.to_ndarray(format="rgb24")
        return np.ascontiguousarray(np.rot90(pixels, self.turns)) if self.turns else pixels

    def grey(self, width: int) -> UInt8[np.ndarray, "h w"]:
        frame = self.frame
        width = min(width, frame.width)
        height = max(1, round(frame.height * width / frame.width))
        return frame.reformat(
            width=width, height=height, format="gray", interpolation="AREA"
        ).to_ndarray()


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
                return ImageOps.exif_transpose(image).convert("RGB")
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


def quarter_turns(frame) -> int:
    """Counter-clockwise quarter turns that set the frame upright; phones store them apart."""
    return round(getattr(frame, "rotation", 0) / 90) % 4
