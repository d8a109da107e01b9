"""Reading npz files: without pickles, and safely from several threads."""

from __future__ import annotations

import threading
import zipfile
from pathlib import Path
from typing import IO

import numpy as np
from numpy.lib import format as npy

# numpy parses the header of an array with `ast`, whose recursion depth CPython counts for all
# threads together in 3.11 (python/cpython#106905): reading in a pool failed once in a while.
_header_lock = threading.Lock()


def load_arrays(path: Path) -> dict[str, np.ndarray]:
    """All arrays of an npz; pickled content is refused (it could run code).

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: not an npz, damaged, or holding pickled objects.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return {
                name.removesuffix(".npy"): _member(archive, name) for name in archive.namelist()
            }
    except FileNotFoundError:
        raise
    except Exception as error:  # zipfile, zlib, numpy and EOF errors all mean the same here
        raise ValueError(f"not a readable npz without pickled objects ({error})") from error


def _member(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    with archive.open(name) as file:
        with _header_lock:
            shape, fortran, dtype = _header(file)
        if dtype.hasobject:
            raise ValueError(f"{name} holds pickled objects")
        content = file.read()
    values = np.frombuffer(bytearray(content), dtype)
    return values.reshape(shape, order="F" if fortran else "C")


def _header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    version = npy.read_magic(file)
    read = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}.get(version)
    if read is None:
        raise ValueError(f"npy version {version} is not supported")
    return read(file)
