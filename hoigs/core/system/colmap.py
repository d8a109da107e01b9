"""pycolmap; every module takes it from here.

Importing it installs handlers of glog: SIGTERM would print a stack and end the process at once, and
locks and temporary files would stay. SIGTERM is set back to what it was.
"""

from __future__ import annotations

import signal
import threading
from pathlib import Path
from typing import Any

import pycolmap

from hoigs.core.system.colmap_files import is_binary, text_models, text_names

_before = signal.getsignal(signal.SIGTERM)
__all__ = ["pycolmap", "read_model"]

# Python sets handlers in its main thread alone
if threading.current_thread() is threading.main_thread() and _before is not None:
    signal.signal(signal.SIGTERM, _before)


def read_model(folder: Path) -> Any:
    """pycolmap's reconstruction of a model folder, names in text with their spaces.

    Raises:
        ValueError, RuntimeError, IndexError: it cannot be read; the message names a camera model
            that this COLMAP does not know.
    """
    if not is_binary(folder) and (folder / "cameras.txt").is_file():
        unknown = text_models(folder / "cameras.txt") - set(pycolmap.CameraModelId.__members__)
        if unknown:
            raise ValueError(
                f"pycolmap {pycolmap.__version__} has no camera model {', '.join(sorted(unknown))}"
            )
    model: Any = pycolmap.Reconstruction(str(folder))
    if not is_binary(folder):
        for number, name in text_names(folder / "images.txt").items():
            if number in model.images:
                model.images[number].name = name
    return model
