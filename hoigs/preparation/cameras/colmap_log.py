"""COLMAP without a log line for every image."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """COLMAP logs only errors in this block."""
    from hoigs.core.machine.colmap import pycolmap

    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level
