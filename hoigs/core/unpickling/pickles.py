"""Pickles of data sets and programs, read as plain values: no code of a file is run.

Python's own loader calls whatever a pickle names, with whatever arguments it gives, and lets it
write into any object. Here a name stands for a function of this module that makes one plain value
and checks its arguments; items are added to lists, sets and dictionaries only; and an array is made
from bytes of exactly its size. So a file can ask for no more memory than a small multiple of its
own length.
"""

from __future__ import annotations

import io
import pickle
import re
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from tokenize import TokenError
from typing import IO, Any, ClassVar

import numpy as np

from hoigs.core.errors import ClipError
from hoigs.core.files.npz import MOST_RATIO, SMALL_BYTES
from hoigs.core.files.whole_files import regular

NUMBERS = re.compile(r"[<>=|]?(\?|[biufcSU]\d{0,7}|O8?)")  # types that an array may have
DEEPEST = 100  # levels of containers in containers
MOST_ITEMS = 20_000_000  # a container counts anew wherever it stands
LONGEST_RANGE = 1_000_000


class Unfinished:
    """A value whose content follows in a later instruction (BUILD).

    Attributes:
        keys: of the memo, where it stands until it is replaced by the value.
    """

    def __init__(self) -> None:
        self.keys: list[int] = []

    def build(self, state: Any, file: IO[bytes]) -> Any:
        """The value; `file` stands behind the instruction."""
        raise NotImplementedError


class _Type(Unfinished):
    """numpy's dtype; its byte order follows."""

    def __init__(self, code: Any, align: Any = False, copy: Any = False) -> None:
        super().__init__()
        del align, copy
        if not isinstance(code, str) or not NUMBERS.fullmatch(code):
            raise _refused(f"arrays of type {code!r:.40}")
        self.value = np.dtype(code)

    def build(self, state: Any, file: IO[bytes]) -> np.dtype:
        del file
        if not isinstance(state, tuple) or len(state) < 5 or any(x is not None for x in state[2:5]):
            raise _refused("arrays of records")
        order = state[1]
        if not isinstance(order, str) or order not in "<>=|":
            raise _refused(f"the byte order {order!r:.20}")
        return self.value if order == "|" else self.value.newbyteorder(order)


class _Array(Unfinished):
    """An array; its shape, type and bytes follow."""

    def __init__(self, kind: Any, shape: Any, code: Any) -> None:
        super().__init__()
        del shape, code  # of an empty one, which is thrown away
        if kind is not NDARRAY:
            raise _refused("a subclass of numpy's array")

    def build(self, state: Any, file: IO[bytes]) -> np.ndarray:
        del file
        if not isinstance(state, tuple) or len(state) != 5:
            raise _refused("an array without its state")
        _, shape, dtype, columns, content = state
        return array_of(content, dtype, shape, "F" if columns else "C")


def array_of(content: Any, dtype: Any, shape: Any, order: str) -> np.ndarray:
    """The array [*shape] of these bytes, or of a list of Python values (type "O").

    Raises:
        UnpicklingError: the bytes are not as many as type and shape need.
    """
    count = checked_count(shape)
    dtype = checked_type(dtype)
    if isinstance(content, str):  # Python 2
        content = content.encode("latin1")
    if dtype.hasobject:
        if type(content) is not list or len(content) != count:
            raise _refused("an array of Python objects that are not listed")
        values = np.empty(count, dtype=object)
        for i, value in enumerate(content):
            values[i] = value
    elif not isinstance(content, bytes | bytearray):
        raise _refused("an array whose content is not bytes")
    elif len(content) != count * dtype.itemsize:
        raise _refused(f"an array {shape} of {dtype} in {len(content)} bytes")
    elif dtype.itemsize == 0:  # texts that are all empty
        if count > LONGEST_RANGE:
            raise _refused(f"{count} empty texts")
        values = np.zeros(count, dtype)
    else:
        values = np.frombuffer(content, dtype).copy()
    return values.reshape(shape[::-1]).T if order == "F" else values.reshape(shape)


def checked_count(shape: Any) -> int:
    """How many numbers an array of this shape has."""
    if not isinstance(shape, tuple) or len(shape) > 32:
        raise _refused("an array without a shape")
    count = 1
    for size in shape:
        if type(size) is not int or size < 0:
            raise _refused(f"an array of shape {shape!r:.60}")
        count *= size
    return count


def checked_type(dtype: Any) -> np.dtype:
    found = dtype.value if isinstance(dtype, _Type) else dtype
    if not isinstance(found, np.dtype) or not NUMBERS.fullmatch(found.str):
        raise _refused(f"an array of type {found!r:.60}")
    return found


def _from_buffer(content: Any, dtype: Any, shape: Any, order: Any, axes: Any = None) -> np.ndarray:
    if checked_type(dtype).hasobject or axes is not None:
        raise _refused("an array of Python objects")
    return array_of(content, dtype, shape, "F" if order == "F" else "C")


def _scalar(dtype: Any, content: Any = b"") -> Any:
    return _from_buffer(content, dtype, (1,), "C")[0]


def _encoded(text: Any, encoding: Any = "latin1") -> bytes:
    if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
        raise _refused("encoded text")
    return text.encode("latin1")


def _items(values: Any = ()) -> list[Any]:
    if not isinstance(values, list | tuple | set | frozenset):
        raise _refused(f"a set of {type(values).__name__}")
    return list(values)


def _pairs(values: Any = ()) -> list[tuple[Any, Any]]:
    return [(k, v) for k, v in _items(values)]


def _byte_array(content: Any = b"", encoding: Any = None) -> bytearray:
    if isinstance(content, str):
        content = _encoded(content, encoding)
    if not isinstance(content, bytes):
        raise _refused("a bytearray of something else than bytes")
    return bytearray(content)


def _range(*ends: Any) -> range:
    found = range(*ends)
    if len(found) > LONGEST_RANGE:
        raise _refused(f"a range of {len(found)} numbers")
    return found


def storage(content: Any) -> Any:
    """The numbers of a tensor; torch's own function would unpickle them without any check.

    Onto the CPU: the authors may have saved them from a GPU that is not here.
    """
    import torch

    if not isinstance(content, bytes):
        raise _refused("a tensor without bytes")
    file = io.BytesIO(content)
    if zipfile.is_zipfile(file):
        with zipfile.ZipFile(file) as packed:
            size = sum(entry.file_size for entry in packed.infolist())
        if size > max(SMALL_BYTES, MOST_RATIO * len(content)):
            raise _refused(f"a tensor whose {len(content)} bytes unfold to {size}")
    return torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)


def _tensor(numbers: Any, start: Any, size: Any, stride: Any, *others: Any) -> Any:
    """torch's `_rebuild_tensor_v2`, within what the storage holds."""
    import torch

    if not isinstance(numbers, torch.storage.TypedStorage):
        raise _refused("a tensor without its storage")
    checked_count(size), checked_count(stride)
    if type(start) is not int or start < 0 or len(size) != len(stride) or any(others[1:2]):
        raise _refused("a tensor that torch does not write")
    last = start + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    flat = torch.empty(0, dtype=numbers.dtype).set_(numbers._untyped_storage)
    if 0 not in size and last >= len(flat):
        raise _refused("a tensor larger than its storage")
    return flat.as_strided(size, stride, start) if 0 not in size else flat[:0].reshape(size)


NDARRAY = object()  # numpy.ndarray as an argument; it cannot be called
_NUMPY: dict[str, Any] = {"_reconstruct": _Array, "scalar": _scalar}
_BUILTINS: dict[str, Any] = {
    "dict": lambda *args: dict(_pairs(*args)),
    "set": lambda *args: set(_items(*args)),
    "frozenset": lambda *args: frozenset(_items(*args)),
    "complex": lambda real=0.0, imag=0.0: complex(float(real), float(imag)),
    "bytearray": _byte_array,
    "slice": slice,
    "range": _range,
}
# module of the pickle (numpy 1 and 2 name the same functions differently) -> name -> what is called
ALLOWED: dict[str, dict[str, Any]] = {
    "numpy": {"ndarray": NDARRAY, "dtype": _Type},
    "numpy.core.multiarray": _NUMPY,
    "numpy._core.multiarray": _NUMPY,
    "numpy.core.numeric": {"_frombuffer": _from_buffer},
    "numpy._core.numeric": {"_frombuffer": _from_buffer},
    "collections": {
        "OrderedDict": lambda *args: OrderedDict(_pairs(*args)),
        "defaultdict": lambda *factory: {},  # WHAM: a defaultdict of dict; it is only read here
    },
    "_codecs": {"encode": _encoded},  # how protocol 2 spells bytes
    "torch._utils": {"_rebuild_tensor_v2": _tensor},  # HOLD saves some arrays as tensors
    "torch.storage": {"_load_from_bytes": storage},
    "builtins": _BUILTINS,
    "__builtin__": _BUILTINS,  # Python 2
}


class _Memo(dict[int, Any]):
    """Values that a pickle refers back to; unfinished ones learn where they stand."""

    def __setitem__(self, key: int, value: Any) -> None:
        if isinstance(value, Unfinished):
            value.keys.append(key)
        super().__setitem__(key, value)


_PythonUnpickler: Any = pickle._Unpickler  # the C version cannot be held to these rules


class PlainUnpickler(_PythonUnpickler):  # type: ignore[misc]  # which is Any
    """Reads one value; `names` are the functions it may call."""

    dispatch: ClassVar[dict[int, Callable[..., None]]] = dict(_PythonUnpickler.dispatch)
    names: ClassVar[dict[str, dict[str, Any]]] = ALLOWED

    def __init__(self, content: bytes, start: int = 0) -> None:
        self.file = io.BytesIO(content)
        self.file.seek(start)
        self.length = len(content)
        super().__init__(self.file, encoding="latin1")
        self.memo = _Memo()

    def find_class(self, module: str, name: str) -> Any:
        found = self.names.get(module, {}).get(name)
        if found is None:
            raise _refused(f"{module}.{name}")
        return found

    def _call(self, function: Any, args: Any) -> None:
        known = any(function is f for names in self.names.values() for f in names.values())
        if not known or function is NDARRAY or not isinstance(args, tuple):
            raise _refused("a call of something that is no function")
        self.stack.append(function(*args))

    def load_reduce(self) -> None:
        args = self.stack.pop()
        self._call(self.stack.pop(), args)

    def load_newobj_ex(self) -> None:
        named = self.stack.pop()
        if named:
            raise _refused("arguments by name")
        self.load_reduce()

    def load_inst(self) -> None:
        module, name = (self.readline()[:-1].decode("ascii") for _ in range(2))
        self._call(self.find_class(module, name), tuple(self.pop_mark()))

    def load_obj(self) -> None:
        function, *args = self.pop_mark()
        self._call(function, tuple(args))

    def load_build(self) -> None:
        state = self.stack.pop()
        unfinished = self.stack[-1]
        if not isinstance(unfinished, Unfinished):
            raise _refused(f"attributes of a {type(unfinished).__name__}")
        value = self.stack[-1] = unfinished.build(state, self.file)
        for key in unfinished.keys:
            self.memo[key] = value

    def load_append(self) -> None:
        value = self.stack.pop()
        self._only(list).append(value)

    def load_appends(self) -> None:
        values = self.pop_mark()
        self._only(list).extend(values)

    def load_setitem(self) -> None:
        value, key = self.stack.pop(), self.stack.pop()
        self._only(dict, OrderedDict)[key] = value

    def load_setitems(self) -> None:
        values = self.pop_mark()
        self._only(dict, OrderedDict).update(zip(values[::2], values[1::2], strict=True))

    def load_additems(self) -> None:
        values = self.pop_mark()
        self._only(set).update(values)

    def _only(self, *kinds: type) -> Any:
        if type(self.stack[-1]) not in kinds:
            raise _refused(f"items of a {type(self.stack[-1]).__name__}")
        return self.stack[-1]

    def load_bytearray8(self) -> None:
        size = int.from_bytes(self.read(8), "little")
        if size > self.length:
            raise EOFError("the file ends within bytes")
        self.stack.append(bytearray(self.read(size)))

    def load_refused(self) -> None:
        raise _refused("an object from outside of the file")

    for _name, _method in {
        "REDUCE": load_reduce, "NEWOBJ": load_reduce, "NEWOBJ_EX": load_newobj_ex,
        "INST": load_inst, "OBJ": load_obj, "BUILD": load_build,
        "APPEND": load_append, "APPENDS": load_appends, "SETITEM": load_setitem,
        "SETITEMS": load_setitems, "ADDITEMS": load_additems, "BYTEARRAY8": load_bytearray8,
        "PERSID": load_refused, "BINPERSID": load_refused, "EXT1": load_refused,
        "EXT2": load_refused, "EXT4": load_refused, "NEXT_BUFFER": load_refused,
        "READONLY_BUFFER": load_refused,
    }.items():  # fmt: skip
        dispatch[getattr(pickle, _name)[0]] = _method

    def plain(self) -> Any:
        """The value of the file, whose containers hold plain values and no end of items.

        Raises:
            UnpicklingError: it holds anything else.
        """
        value = self.load()
        _count(value, {}, 0)
        return value


def _count(value: Any, counts: dict[int, int], depth: int) -> int:
    """How many values a value holds, where one that stands in several places counts in each."""
    if depth > DEEPEST:
        raise _refused(f"containers more than {DEEPEST} deep")
    if isinstance(value, Unfinished) or value is NDARRAY or callable(value):
        raise _refused("a function in place of a value")
    if isinstance(value, np.ndarray) and value.dtype.hasobject:
        inside: Any = value.flat
    elif isinstance(value, dict):
        inside = (x for pair in value.items() for x in pair)
    elif isinstance(value, list | tuple | set | frozenset):
        inside = value
    else:
        return 1
    if id(value) not in counts:
        counts[id(value)] = MOST_ITEMS  # what holds itself has no end
        counts[id(value)] = 1 + sum(_count(x, counts, depth + 1) for x in inside)
    if counts[id(value)] >= MOST_ITEMS:
        raise _refused(f"more than {MOST_ITEMS} values")
    return counts[id(value)]


def _refused(what: str) -> pickle.UnpicklingError:
    return pickle.UnpicklingError(
        f"it contains {what}; only numbers, texts, arrays of numbers, lists and dictionaries are "
        "allowed, so save only these"
    )


def load_pickle(path: Path) -> Any:
    """The content of a .pkl of plain values and numpy arrays, written by Python 2 or 3.

    Raises:
        ClipError: it is damaged, or holds anything else; no code in it is run.
    """
    with regular(path).open("rb") as file:
        return _load(file, path)


def load_pickled_npy(path: Path) -> Any:
    """The value that `numpy.save` wrote as a pickle, as data sets keep dictionaries in .npy files.

    An .npy file of plain numbers gives its array.

    Raises:
        ClipError: as `load_pickle`.
    """
    with regular(path).open("rb") as file:
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
    if not isinstance(array, np.ndarray) or array.shape != shape:
        raise ClipError(f"{path} is not a readable .npy file (its header says {shape})")
    return array.item() if shape == () else array


def _load(file: IO[bytes], path: Path) -> Any:
    try:
        return PlainUnpickler(file.read()).plain()
    except Exception as error:  # a damaged pickle raises anything
        raise ClipError(f"{path} cannot be read: {error or type(error).__name__}") from error
