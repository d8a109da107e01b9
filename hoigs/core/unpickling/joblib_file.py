"""Files of joblib.dump, read without joblib and without running any code in them.

joblib writes a pickle in which each array is a small wrapper (shape, order, type), followed at once
by the array's bytes (joblib/numpy_pickle.py), which are read where they stand.
"""

from __future__ import annotations

import io
import pickle
import zlib
from pathlib import Path
from typing import IO, Any, ClassVar

import numpy as np

from hoigs.core.errors import ClipError
from hoigs.core.files.npz import MOST_RATIO, SMALL_BYTES
from hoigs.core.files.whole_files import regular
from hoigs.core.unpickling.pickles import (
    ALLOWED,
    PlainUnpickler,
    Unfinished,
    array_of,
    checked_count,
    checked_type,
)


class _Wrapper(Unfinished):
    """What joblib writes in place of an array, whose bytes follow."""

    def build(self, state: Any, file: IO[bytes]) -> np.ndarray:
        if not isinstance(state, dict):
            raise pickle.UnpicklingError("an array of joblib has no shape")
        dtype, shape = checked_type(state.get("dtype")), state.get("shape")
        if dtype.hasobject:
            raise pickle.UnpicklingError("it holds arrays of Python objects; save numbers")
        size = checked_count(shape) * dtype.itemsize
        if state.get("numpy_array_alignment_bytes") is not None:  # joblib 1.2 on
            file.read(file.read(1)[0])
        start, end = file.tell(), file.seek(0, io.SEEK_END)
        if size > end - start:
            raise EOFError("the file ends within an array")
        file.seek(start)
        return array_of(file.read(size), dtype, shape, "F" if state.get("order") == "F" else "C")


class _JoblibUnpickler(PlainUnpickler):
    names: ClassVar = ALLOWED | {"joblib.numpy_pickle": {"NumpyArrayWrapper": _Wrapper}}


def _decompressed(content: bytes) -> bytes:
    """What zlib or gzip packed, in bounds: a small file may unfold to any size."""
    most = max(SMALL_BYTES, MOST_RATIO * len(content))
    unpack = zlib.decompressobj(wbits=zlib.MAX_WBITS | 32)  # either of both
    found = unpack.decompress(content, most)
    if not unpack.eof:
        if len(found) < most:
            raise EOFError("the file is cut off")
        raise ValueError(f"its {len(content)} bytes unfold to more than {most / 2**30:.2g} GiB")
    return found


def load_joblib(path: Path) -> Any:
    """The content of a .pkl of joblib.dump: plain values and numpy arrays.

    Files without compression, or with zlib's or gzip's, are read; so are plain pickles.

    Raises:
        ClipError: it is damaged, or holds anything else; no code in it is run.
    """
    try:
        content = regular(path).read_bytes()
        if content[:2] == b"\x1f\x8b" or content[:1] == b"\x78":
            content = _decompressed(content)
        return _JoblibUnpickler(content).plain()
    except Exception as error:  # a damaged pickle raises anything
        raise ClipError(f"{path} cannot be read: {error or type(error).__name__}") from error
