"""A long clip in windows: pieces of equal length that overlap."""

from __future__ import annotations

from dataclasses import dataclass

LONGEST = 50  # frames of overlap, where none is given
LEAST = 4  # frames of overlap with which windows can be joined


@dataclass(frozen=True)
class Chunking:
    """How a clip is cut into windows.

    Attributes:
        chunk: frames of a window, at most. overlap: frames that neighbours share.

    Raises:
        ValueError: the windows are too short, share too little to be joined, or more than half.
    """

    chunk: int
    overlap: int

    @staticmethod
    def of(chunk: int, overlap: int | None = None) -> Chunking:
        """Without an overlap, a quarter of the window's frames, 50 at most."""
        return Chunking(chunk, max(LEAST, min(LONGEST, chunk // 4)) if overlap is None else overlap)

    def __post_init__(self) -> None:
        if self.chunk < 2 * LEAST:
            raise ValueError(f"a chunk of {self.chunk} frames; windows need {2 * LEAST} or more")
        if not LEAST <= self.overlap <= self.chunk // 2:
            raise ValueError(
                f"an overlap of {self.overlap} frames; windows of {self.chunk} frames have to share"
                f" {LEAST} or more to be joined, and may share {self.chunk // 2}, half of them"
            )

    def windows(self, frames: int) -> list[slice]:
        """Windows over `frames` frames, in order; one alone where all frames fit in it."""
        stride = self.chunk - self.overlap
        count = max(1, -(-(frames - self.overlap) // stride))
        starts = [k * (frames - self.overlap) // count for k in range(count)]
        stops = [start + self.overlap for start in starts[1:]] + [frames]
        return [slice(a, b) for a, b in zip(starts, stops, strict=True)]
