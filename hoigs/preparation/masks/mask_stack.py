"""Masks of a video's frames: kept as bits, measured, cleaned."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy import ndimage

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
