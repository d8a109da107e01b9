"""Masks of all frames, packed; their outlines and parts."""

from __future__ import annotations

import tempfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy import ndimage

from hoigs.core.maths.frame_times import fill_gaps
from hoigs.preparation.video.source import SourceError

Images = Callable[[], Iterable[UInt8[np.ndarray, "H W 3"]]]  # all frames anew on every call
LEVEL = 1  # of zlib, its fastest


class MaskStack:
    """One mask a frame, deflated, so that a long video's masks fit in memory."""

    def __init__(self, masks: Iterable[Bool[np.ndarray, "H W"]] = ()) -> None:
        self._packed: list[bytes] = []
        self._shape = (0, 0)
        for mask in masks:
            self.append(mask)

    @staticmethod
    def from_deflated(
        deflated: UInt8[np.ndarray, " B"], lengths: Int[np.ndarray, " F"], shape: tuple[int, int]
    ) -> MaskStack:
        """From what `deflated` and `shape` give."""
        stack, ends = MaskStack(), np.cumsum(lengths)
        stack._shape = shape
        spans = zip(ends - lengths, ends, strict=True)
        stack._packed = [deflated[start:end].tobytes() for start, end in spans]
        return stack

    def deflated(self) -> tuple[UInt8[np.ndarray, " B"], Int[np.ndarray, " F"]]:
        """The masks as they are kept, one after another, and the bytes of each."""
        lengths = np.array([len(packed) for packed in self._packed], np.int64)
        return np.frombuffer(b"".join(self._packed), np.uint8), lengths

    @property
    def bits(self) -> UInt8[np.ndarray, "F H B"]:
        """Eight pixels of a row a byte."""
        found = np.empty((len(self), self._shape[0], -(-self._shape[1] // 8)), np.uint8)
        for frame in range(len(self)):
            found[frame] = self._rows(frame)
        return found

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width."""
        return self._shape

    def append(self, mask: Bool[np.ndarray, "H W"]) -> None:
        self._shape = mask.shape
        self._packed.append(zlib.compress(np.packbits(mask, axis=1).data, LEVEL))

    def __len__(self) -> int:
        return len(self._packed)

    def __getitem__(self, frame: int) -> Bool[np.ndarray, "H W"]:
        return np.unpackbits(self._rows(frame), axis=1, count=self._shape[1]).astype(bool)

    def __iter__(self) -> Iterator[Bool[np.ndarray, "H W"]]:
        return (self[i] for i in range(len(self)))

    def _rows(self, frame: int) -> UInt8[np.ndarray, "H B"]:
        """A frame's bits."""
        rows = np.frombuffer(zlib.decompress(self._packed[frame]), np.uint8)
        return rows.reshape(self._shape[0], -1)

    def coverage(self) -> Float[np.ndarray, " F"]:
        """Part of the image that each mask covers, 0..1."""
        pixels = max(1, self._shape[0] * self._shape[1])
        return np.array([mask.sum() / pixels for mask in self])


def largest_parts(mask: Bool[np.ndarray, "H W"], smallest: float = 0.05) -> Bool[np.ndarray, "H W"]:
    """The mask without crumbs: parts under `smallest` of its largest part are dropped."""
    labels, count = ndimage.label(mask)
    if count < 2:
        return mask
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return (sizes >= smallest * sizes.max())[labels] & mask


# Measures of a mask's outline: its middle and its length.

SMALL = 0.25  # of the median area: a segmenter that lost the object leaves such crumbs


@dataclass(frozen=True)
class Outlines:
    """Measures of a mask over the frames.

    Attributes:
        centers: centroids, pixels, interpolated where not observed.
        lengths: of the long axis (four standard deviations), pixels; NaN where not whole.
        areas: pixels. observed: not empty, nor a crumb. whole: observed, and not cut by the
            image's border.
    """

    centers: Float[np.ndarray, "F 2"]
    lengths: Float[np.ndarray, " F"]
    areas: Float[np.ndarray, " F"]
    observed: Bool[np.ndarray, " F"]
    whole: Bool[np.ndarray, " F"]


def outlines_of(masks: MaskStack) -> Outlines:
    """Measures of every mask.

    Raises:
        SourceError: all masks are empty.
    """
    areas = np.array([float(m.sum()) for m in masks])
    if not areas.any():
        raise SourceError("the object's mask is empty in every frame: there is nothing to track")
    observed = areas >= SMALL * np.median(areas[areas > 0])
    count = len(masks)
    centers, lengths = np.zeros((count, 2)), np.full(count, np.nan)
    whole = np.zeros(count, dtype=bool)
    for i in np.flatnonzero(observed).tolist():
        mask = masks[i]
        xy = np.argwhere(mask)[:, ::-1] + 0.5
        centers[i] = xy.mean(0)
        whole[i] = not cut_off(mask)
        if whole[i]:
            lengths[i] = 4 * np.sqrt(np.linalg.eigvalsh(np.cov(xy.T, bias=True))[1])
    filled = fill_gaps(centers, observed)
    return Outlines(filled, lengths, areas, observed, whole)


def cut_off(mask: Bool[np.ndarray, "H W"]) -> bool:
    """Whether the mask touches the image's border."""
    return bool(mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any())


# Arrays of one shape, one a frame, in a nameless temporary file: memory holds one at a time.


class FrameFile:
    """Reads and writes whole frames; a memory map's pages would count as the process's memory.

    The system deletes the file when this object goes, however the process ends.
    """

    def __init__(self, folder: Path | None, frames: Iterable[np.ndarray]) -> None:
        """Writes `frames`, all of one shape and type.

        Args:
            folder: where the file lies; None: the system's temporary folder.
        """
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115
        self._shape: tuple[int, ...] = ()
        self._type = np.dtype(np.uint8)
        self._count = 0
        for frame in frames:
            if not self._count:
                self._shape, self._type = frame.shape, frame.dtype
            if (frame.shape, frame.dtype) != (self._shape, self._type):
                raise ValueError(
                    f"frame {self._count}: expected {self._shape} of {self._type}, as the frames "
                    f"before, got {frame.shape} of {frame.dtype}"
                )
            self._file.write(np.ascontiguousarray(frame).data)
            self._count += 1

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, frame: int) -> np.ndarray:
        if not 0 <= frame < self._count:
            raise IndexError(f"frame {frame} of {self._count}")
        found = np.empty(self._shape, self._type)
        self._file.seek(frame * found.nbytes)
        self._file.readinto(found.data.cast("B"))
        return found

    def __iter__(self) -> Iterator[np.ndarray]:
        return (self[i] for i in range(self._count))
