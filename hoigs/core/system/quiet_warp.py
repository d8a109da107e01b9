"""Warp, initialised once and quietly; every module of hoigs takes `wp` from here."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager

import warp as wp

from hoigs.core.errors import HoigsError

__all__ = ["wp"]
NO_DRIVER = "Could not find or load the NVIDIA CUDA driver"


def start() -> None:
    """Initialise Warp without its banner, its list of devices and its notice of each module.

    Raises:
        HoigsError: the folder of its kernels cannot be made.
    """
    try:
        _init()
    except OSError as error:
        raise HoigsError(
            f"{error.filename}: Warp cannot keep its kernels there ({error.strerror}); set "
            "WARP_CACHE_PATH to a folder that can be written to"
        ) from error


def _init() -> None:
    if not hasattr(wp.config, "log_level"):  # Warp before 1.12
        setattr(wp.config, "quiet", True)  # noqa: B010
        wp.init()
        return
    level = wp.config.log_level
    wp.config.log_level = max(level, 40)  # no warning on a machine without CUDA
    with _without_driver_notice():
        wp.init()
    wp.config.log_level = max(level, 30)


@contextmanager
def _without_driver_notice() -> Iterator[None]:
    """Drop the line that Warp's C++ prints to stderr where there is no CUDA driver, no other."""
    sys.stderr.flush()
    with tempfile.TemporaryFile() as caught:
        saved = os.dup(2)
        os.dup2(caught.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            caught.seek(0)
            for line in caught.read().decode(errors="replace").splitlines():
                if NO_DRIVER not in line:
                    print(line, file=sys.stderr)


start()
