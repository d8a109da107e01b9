"""COLMAP without lines of its log in the terminal."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """COLMAP logs nothing in this block: an attempt that fails is followed by others, and if all do
    there is an error of ours."""
    from hoigs.core.machine.colmap import pycolmap

    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level
