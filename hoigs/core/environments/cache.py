"""The folder in which hoigs keeps what it can make again."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from hoigs.core.errors import HoigsError


def cache_folder() -> Path:
    """`HOIGS_CACHE`, or else hoigs/ in the user's folder for caches (`XDG_CACHE_HOME`)."""
    own = os.environ.get("HOIGS_CACHE")
    if own:
        return Path(own).expanduser()
    xdg = os.environ.get("XDG_CACHE_HOME")
    if xdg and Path(xdg).is_absolute():  # the XDG specification: relative ones are ignored
        return Path(xdg) / "hoigs"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home())) / "hoigs" / "cache"
    return Path.home() / ".cache" / "hoigs"


def made(folder: Path) -> Path:
    """A folder in the cache, made where it is absent.

    Raises:
        HoigsError: it cannot be made; the message names the variable that chooses another place.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise HoigsError(
            f"{folder}: cannot be made ({error.strerror}); set HOIGS_CACHE to a folder that can be "
            "written to"
        ) from error
    return folder
