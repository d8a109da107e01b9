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
from typing import Any, ClassVar, Literal

import numpy as np

from hoigs.core.errors import ClipError
from hoigs.core.system.files import regular_file
from hoigs.core.system.npz import MOST_RATIO, SMALL_BYTES
from hoigs.core.system.unpickling import Named, Opcodes, Unpickler, refused

WRAPPER = Named("joblib.numpy_pickle.NumpyArrayWrapper", None)


class _Wrapper:
    """What joblib writes in place of an array, until its state is read."""


class _Unpickler(Unpickler):
    dispatch: ClassVar[Opcodes] = Opcodes(Unpickler.dispatch)

    def find_class(self, module: str, name: str) -> Any:
        return WRAPPER if f"{module}.{name}" == WRAPPER.name else super().find_class(module, name)

    def load_newobj(self) -> None:
        arguments, kind = self.stack.pop(), self.stack.pop()
        if kind is not WRAPPER or arguments != ():
            raise refused("it makes an object of a class; only numbers and arrays are read")
        self.append(_Wrapper())

    def load_build(self) -> None:
        if type(self.stack[-2]) is not _Wrapper:
            return super().load_build()
        state = self.stack.pop()
        self.stack[-1] = self._array(state)

    def _array(self, state: dict[str, Any]) -> np.ndarray:
        """The array whose bytes follow now."""
        if state.get("numpy_array_alignment_bytes") is not None:  # joblib 1.2 on
            self.content.read(self.content.read(1)[0])
        shape, dtype = state["shape"], state["dtype"]
        content = self.content.read(self.calls.nbytes(shape, dtype))
        order: Literal["C", "F"] = "F" if state["order"] == "F" else "C"
        return self.calls.array(shape, dtype, bytearray(content), order)


_Unpickler.dispatch[pickle.NEWOBJ[0]] = _Unpickler.load_newobj
_Unpickler.dispatch[pickle.BUILD[0]] = _Unpickler.load_build


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
        return _Unpickler(io.BytesIO(content), len(content)).load()
    except Exception as error:  # a damaged pickle raises anything
        raise ClipError(f"{path} cannot be read: {error or type(error).__name__}") from error
