"""The folder in which hoigs keeps what it can make again."""

from __future__ import annotations

import os
import sys
from pathlib import Path


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
