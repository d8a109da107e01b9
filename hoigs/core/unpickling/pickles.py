"""Pickled dictionaries of data sets and programs, read without running any code in them.

Python's own loader calls any function that a pickle names. Data sets hold dictionaries of numbers
and arrays, so here only the functions that make those are allowed.
"""

from __future__ import annotations

import io
import pickle
from pathlib import Path
from tokenize import TokenError
from typing import IO, Any

import numpy as np

from hoigs.core.errors import ClipError
from hoigs.core.files.regular_file import regular_file

# module of the pickle (numpy 1 and 2 name the same functions differently) -> names
_NUMPY = ("_reconstruct", "scalar")
ALLOWED = {
    "numpy": ("ndarray", "dtype"),
    "numpy.core.multiarray": _NUMPY,
    "numpy._core.multiarray": _NUMPY,
    "numpy.core.numeric": ("_frombuffer",),
    "numpy._core.numeric": ("_frombuffer",),
    "collections": ("OrderedDict", "defaultdict"),  # WHAM: a defaultdict of dict
    "_codecs": ("encode",),  # how protocol 2 spells bytes
    "torch._utils": ("_rebuild_tensor_v2",),  # HOLD saves some arrays as tensors
    "builtins": ("dict", "set", "frozenset", "complex", "bytearray", "slice", "range"),
}
ALLOWED["__builtin__"] = ALLOWED["builtins"]  # Python 2


def refuse_unknown(module: str, name: str) -> None:
    """UnpicklingError for what a pickle names, unless it is in `ALLOWED`."""
    if name not in ALLOWED.get(module, ()):
        raise pickle.UnpicklingError(
            f"it contains {module}.{name}; only numbers, arrays, lists and dictionaries "
            "are allowed, so save only these"
        )


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("torch.storage", "_load_from_bytes"):
            return storage
        refuse_unknown(module, name)
        return super().find_class(module, name)


def storage(content: bytes) -> Any:
    """The numbers of a tensor; torch's own function would unpickle them without any check.

    Onto the CPU: the authors may have saved them from a GPU that is not here.
    """
    import torch

    return torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)


def load_pickle(path: Path) -> Any:
    """The content of a .pkl of plain values and numpy arrays, written by Python 2 or 3.

    Raises:
        ClipError: it is damaged, or holds anything else; no code in it is run.
    """
    with regular_file(path).open("rb") as file:
        return _load(file, path)


def load_pickled_npy(path: Path) -> Any:
    """The value that `numpy.save` wrote as a pickle, as data sets keep dictionaries in .npy files.

    An .npy file of plain numbers gives its array.

    Raises:
        ClipError: as `load_pickle`.
    """
    with regular_file(path).open("rb") as file:
        try:
            version = np.lib.format.read_magic(file)
            read = {1: np.lib.format.read_array_header_1_0, 2: np.lib.format.read_array_header_2_0}
            shape, _, dtype = read[version[0]](file)
            if not dtype.hasobject:
                file.seek(0)
                return np.load(file, allow_pickle=False)
        # numpy reads a header that is no literal token by token, as Python 2 wrote it
        except (ValueError, KeyError, EOFError, OverflowError, TokenError) as error:
            raise ClipError(f"{path} is not a readable .npy file ({error})") from error
        array = _load(file, path)
    return array.item() if shape == () else array


def _load(file: IO[bytes], path: Path) -> Any:
    try:
        return _Unpickler(file, encoding="latin1").load()
    except Exception as error:  # a damaged pickle raises anything
        raise ClipError(f"{path} cannot be read: {error or type(error).__name__}") from error
