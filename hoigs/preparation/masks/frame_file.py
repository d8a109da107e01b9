"""Arrays of one shape, one a frame, in a nameless temporary file: memory holds one at a time."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np


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
