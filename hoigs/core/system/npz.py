"""Reading npz and npy files: without pickles, sizes before content, safe from several threads."""

from __future__ import annotations

import math
import threading
import zipfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
from numpy.lib import format as npy

from hoigs.core.system.files import regular_file

# numpy parses the header of an array with `ast`, whose recursion depth CPython counts for all
# threads together in 3.11 (python/cpython#106905): reading in a pool failed once in a while.
_header_lock = threading.Lock()

# A small file may claim gigabytes: zeros compress to a thousandth. Arrays of our own files do not
# compress to a hundredth, and small ones may.
SMALL_BYTES = 256 * 2**20
MOST_RATIO = 100


class ArrayHeader(NamedTuple):
    """What is known of an array before it is read."""

    shape: tuple[int, ...]
    dtype: np.dtype
    fortran: bool

    @property
    def nbytes(self) -> int:
        return math.prod(self.shape) * self.dtype.itemsize


def array_headers(path: Path) -> dict[str, ArrayHeader]:
    """Shapes and dtypes of all arrays of an npz, whose content is not read.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: not an npz, damaged, or holding pickled objects.
    """
    found = {}
    with _readable("npz"), zipfile.ZipFile(regular_file(path)) as archive:
        for name in archive.namelist():
            with archive.open(name) as file:
                found[name.removesuffix(".npy")] = _header(file, name)
    return found


def holds(path: Path, names: Collection[str]) -> bool:
    """Whether a file is an npz with arrays of these names; False for what cannot be read."""
    try:
        return set(names) <= set(array_headers(path))
    except (OSError, ValueError):
        return False


def load_arrays(path: Path, only: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """The arrays of an npz; pickled content is refused (it could run code).

    Args:
        only: names to read; None reads all.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: not an npz, damaged, holding pickled objects, or far larger than its file.
    """
    with _readable("npz"), zipfile.ZipFile(regular_file(path)) as archive:
        names = [n for n in archive.namelist() if only is None or n.removesuffix(".npy") in only]
        _check_size(path, sum(archive.getinfo(name).file_size for name in names))
        return {name.removesuffix(".npy"): _member(archive, name) for name in names}


def load_array(path: Path) -> np.ndarray:
    """The array of an npy file; pickled content is refused.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: not an npy, damaged, or holding pickled objects.
    """
    with _readable("npy"), regular_file(path).open("rb") as file:
        return _array(file, path.name, path.stat().st_size)


@contextmanager
def _readable(what: str) -> Iterator[None]:
    """ValueError for all that reading raises, but for a file that is not there."""
    try:
        yield
    except FileNotFoundError:
        raise
    except Exception as error:  # zipfile, zlib, numpy and EOF errors all mean the same here
        reason = plain_reason(error)
        raise ValueError(f"not a readable {what} without pickled objects ({reason})") from error


def plain_reason(error: Exception) -> str:
    """The message of numpy's error, without its advice to allow pickles, which could run code."""
    text = str(error)
    if "allow_pickle=" in text or "pickle.load" in text:
        return "it holds pickled objects, or is no such file"
    return text.split("\n", 1)[0] or "it is empty"


def _check_size(path: Path, size: int) -> None:
    stored = path.stat().st_size
    if size > max(SMALL_BYTES, MOST_RATIO * stored):
        raise ValueError(
            f"its {stored} bytes claim {size / 2**30:.1f} GiB, more than {MOST_RATIO} times as much"
        )


def _member(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    with archive.open(name) as file:
        return _array(file, name, archive.getinfo(name).file_size)


def _array(file: IO[bytes], name: str, size: int) -> np.ndarray:
    """One array; `size` is that of its member or file, header included."""
    header = _header(file, name)
    if header.nbytes > size:
        raise ValueError(f"{name} is cut: {size} bytes for {header.nbytes} of content")
    content = file.read(header.nbytes)
    values = np.frombuffer(bytearray(content), header.dtype, math.prod(header.shape))
    return values.reshape(header.shape, order="F" if header.fortran else "C")


def _header(file: IO[bytes], name: str) -> ArrayHeader:
    header = read_header(file, name)
    if header.dtype.hasobject:
        raise ValueError(f"{name} holds pickled objects")
    return header


def read_header(file: IO[bytes], name: str) -> ArrayHeader:
    """The header of an npy, of objects too; the file stands at the content then.

    Raises:
        ValueError, EOFError, TokenError: it is damaged.
    """
    with _header_lock:
        shape, fortran, dtype = _parsed(file)
    if any(size < 0 for size in shape):
        raise ValueError(f"{name} has the shape {shape}")
    return ArrayHeader(shape, dtype, fortran)


def _parsed(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    version = npy.read_magic(file)
    read = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}.get(version)
    if read is None:
        raise ValueError(f"npy version {version} is not supported")
    try:
        return read(file)
    except ValueError as error:
        # numpy advises to allow pickles where a header is too long; that could run code
        raise ValueError(str(error).split("\n", 1)[0]) from error
