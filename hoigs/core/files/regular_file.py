"""Whether a path is a file of bytes: reading a FIFO waits for a writer, perhaps for ever."""

from __future__ import annotations

import errno
import stat
from pathlib import Path
from typing import TypeVar

AnyPath = TypeVar("AnyPath", str, Path)
OTHER = {
    stat.S_IFIFO: "a FIFO",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


class NotRegularError(OSError):
    """A FIFO, a socket or a device; `strerror` says which, `filename` is the path."""

    def __str__(self) -> str:
        return str(self.strerror)  # messages have the path before it


def regular_file(path: AnyPath) -> AnyPath:
    """`path` itself, if reading it ends; a folder is left to whoever opens it.

    Raises:
        FileNotFoundError: there is nothing.
        NotRegularError: a FIFO, a socket or a device.
    """
    mode = Path(path).stat().st_mode
    if kind := OTHER.get(stat.S_IFMT(mode)):
        raise NotRegularError(errno.EINVAL, f"is {kind}, expected a regular file", str(path))
    return path
