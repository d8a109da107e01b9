"""Files of joblib.dump, read without joblib and without running any code in them.

joblib writes a pickle in which each array is a small wrapper (shape, order, type), followed at once
by the array's bytes (joblib/numpy_pickle.py). Python's own unpickler does not expect such bytes, so
its pure-Python version is extended here to read them.
"""

from __future__ import annotations

import io
import pickle
import zlib
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from hoigs.core.errors import ClipError
from hoigs.core.files.npz import MOST_RATIO, SMALL_BYTES
from hoigs.core.files.regular_file import regular_file
from hoigs.core.unpickling.pickles import refuse_unknown, storage

WRAPPER = ("joblib.numpy_pickle", "NumpyArrayWrapper")


class _Wrapper:
    """What joblib writes in place of an array; its attributes come from the file."""

    shape: tuple[int, ...]
    order: str
    dtype: np.dtype


_PythonUnpickler: Any = pickle._Unpickler  # the C version cannot be extended


class _Unpickler(_PythonUnpickler):  # type: ignore[misc]  # which is Any
    dispatch: ClassVar = dict(_PythonUnpickler.dispatch)

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file, encoding="latin1")
        self.file = file

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == WRAPPER:
            return _Wrapper
        if (module, name) == ("torch.storage", "_load_from_bytes"):
            return storage
        refuse_unknown(module, name)
        return super().find_class(module, name)

    def load_build(self) -> None:
        super().load_build()
        if isinstance(self.stack[-1], _Wrapper):
            self.stack.append(self._array(self.stack.pop()))

    dispatch[pickle.BUILD[0]] = load_build

    def _array(self, wrapper: _Wrapper) -> np.ndarray:
        if wrapper.dtype.hasobject:
            raise pickle.UnpicklingError("it holds arrays of Python objects; save numbers")
        if getattr(wrapper, "numpy_array_alignment_bytes", None) is not None:  # joblib 1.2 on
            self.file.read(self.file.read(1)[0])
        count = int(np.prod(wrapper.shape, dtype=np.int64))
        size = count * wrapper.dtype.itemsize
        content = self.file.read(size)
        if len(content) != size:
            raise EOFError("the file ends within an array")
        values = np.frombuffer(content, dtype=wrapper.dtype).copy()
        if wrapper.order == "F":
            return values.reshape(wrapper.shape[::-1]).T
        return values.reshape(wrapper.shape)


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
        content = regular_file(path).read_bytes()
        if content[:2] == b"\x1f\x8b" or content[:1] == b"\x78":
            content = _decompressed(content)
        return _Unpickler(io.BytesIO(content)).load()
    except Exception as error:  # a damaged pickle raises anything
        raise ClipError(f"{path} cannot be read: {error or type(error).__name__}") from error
