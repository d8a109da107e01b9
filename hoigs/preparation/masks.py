"""Masks of a video's frames: read from files, kept as bits, measured."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from scipy import ndimage

from hoigs.core.undistortion import Undistortion
from hoigs.preparation.frames import Frames
from hoigs.preparation.source import SourceError


class MaskStack:
    """One mask a frame, eight pixels a byte, so that a long video's masks fit in memory."""

    def __init__(self, masks: Iterable[Bool[np.ndarray, "H W"]] = ()) -> None:
        self._bits: list[np.ndarray] = []
        self._shape = (0, 0)
        for mask in masks:
            self.append(mask)

    @staticmethod
    def from_bits(bits: UInt8[np.ndarray, "F H B"], width: int) -> MaskStack:
        """From what `bits` and `width` give."""
        stack = MaskStack()
        stack._bits, stack._shape = list(bits), (bits.shape[1], width)
        return stack

    @property
    def bits(self) -> UInt8[np.ndarray, "F H B"]:
        """Eight pixels of a row a byte."""
        return np.stack(self._bits)

    @property
    def width(self) -> int:
        return self._shape[1]

    def append(self, mask: Bool[np.ndarray, "H W"]) -> None:
        self._shape = mask.shape
        self._bits.append(np.packbits(mask, axis=1))

    def __len__(self) -> int:
        return len(self._bits)

    def __getitem__(self, frame: int) -> Bool[np.ndarray, "H W"]:
        return np.unpackbits(self._bits[frame], axis=1, count=self._shape[1]).astype(bool)

    def __iter__(self) -> Iterator[Bool[np.ndarray, "H W"]]:
        return (self[i] for i in range(len(self)))

    def coverage(self) -> Float[np.ndarray, " F"]:
        """Part of the image that each mask covers, 0..1."""
        pixels = max(1, self._shape[0] * self._shape[1])
        return np.array([mask.sum() / pixels for mask in self])


def load_masks(folder: Path, video: Frames, undistort: Undistortion) -> MaskStack:
    """The masks of the chosen frames, at their size and without lens distortion.

    Files are named by video frame number: 00017.png is frame 17 of the video.

    Raises:
        SourceError: naming the files that are absent, or of another shape than the video.
    """
    paths = [folder / f"{index:05d}.png" for index in video.indices]
    absent = [p.name for p in paths if not p.is_file()]
    if absent:
        shown = ", ".join(absent[:8]) + (", …" if len(absent) > 8 else "")
        raise SourceError(
            f"{folder} lacks {len(absent)} of {len(paths)} masks: {shown}; masks come from your "
            "segmenter, one a video frame, named by frame number, all 0 where nothing is seen"
        )
    return MaskStack(undistort.mask(_read(p, video)) for p in paths)


def _read(path: Path, video: Frames) -> Bool[np.ndarray, "H W"]:
    try:
        with Image.open(path) as image:
            grey = image.convert("L")
    except OSError as error:
        raise SourceError(f"{path} is not a readable image: {error}") from error
    if abs(grey.width * video.height - grey.height * video.width) > video.width + grey.width:
        raise SourceError(
            f"{path} is {grey.width}x{grey.height}, another shape than the video's "
            f"{video.native_width}x{video.native_height}"
        )
    if grey.size != (video.width, video.height):
        grey = grey.resize((video.width, video.height), Image.Resampling.BOX)
    return np.asarray(grey) > 127


def largest_parts(mask: Bool[np.ndarray, "H W"], smallest: float = 0.05) -> Bool[np.ndarray, "H W"]:
    """The mask without crumbs: parts under `smallest` of its largest part are dropped."""
    labels, count = ndimage.label(mask)
    if count < 2:
        return mask
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return (sizes >= smallest * sizes.max())[labels] & mask
