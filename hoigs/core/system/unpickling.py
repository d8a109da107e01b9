"""Pickled dictionaries of data sets and programs, read without running any code in them.

Python's own loader calls any function that a pickle names, and gives any object a state, items or
attributes. Here a pickle makes numbers, texts, arrays, lists and dictionaries: `calls` has the
functions that it may name, and of the opcodes only those are done that such values are written
with. What comes out is looked through once more.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from tokenize import TokenError
from typing import IO, Any, ClassVar, Literal, NamedTuple

import numpy as np

from hoigs.core.errors import ClipError
from hoigs.core.system.files import regular_file
from hoigs.core.system.npz import MOST_RATIO, SMALL_BYTES, load_array, read_header

# What a pickle may name: functions of our own stand for it, which make numbers and arrays only.
#
# No function of numpy is called with what a file says: `numpy.ndarray` on a file's bytes makes
# arrays of pointers, and so runs code. Each function here checks all of its arguments.


# Lists in lists; also the depth at which a list that holds itself is met.
DEEPEST = 64
MOST_AXES = 32  # numpy 1's
# Rows of no numbers that any file may have: [N, 0] takes no bytes.
EMPTY_ROWS = 2**16
_DTYPES = frozenset(
    ("b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8", "f16", "c8", "c16")
)
Names = dict[str, Callable[..., Any] | None]
_LATIN = ("latin1", "latin-1")


def refused(why: str) -> pickle.UnpicklingError:
    return pickle.UnpicklingError(why)


def is_key(value: Any) -> bool:
    """Whether it may be a key of a dictionary or in a set.

    Tuples may not: one that holds another twice, sixty deep, is hashed for ever. Nor may complex
    numbers: a file can hold any number of them that collide.
    """
    plain = isinstance(value, str | bytes | int | float | np.generic)
    return value is None or (plain and not isinstance(value, np.complexfloating))


class Named(NamedTuple):
    """What stands for a class or function of a pickle; `make` is None if it is not called."""

    name: str
    make: Callable[..., Any] | None


@dataclass
class Dtype:
    """A dtype that its state, the byte order, is still to follow."""

    code: str
    order: str = "="

    @property
    def numpy(self) -> np.dtype:
        return np.dtype(self.order + self.code)


class Calls:
    """The functions of one file, and what they may still make.

    Args:
        size: of the file, bytes. All that it makes may take 100 times that, or 256 MiB.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self.most = self.left = max(SMALL_BYTES, MOST_RATIO * size)
        self._unfilled: dict[int, np.ndarray] = {}  # of `_reconstruct`, by id, until their state
        array: Names = {"_reconstruct": self._reconstruct, "scalar": self._scalar}
        buffer: Names = {"_frombuffer": self._frombuffer}
        plain: Names = {
            "dict": None, "set": self.make_set, "frozenset": self._frozenset,
            "complex": self._complex, "bytes": self._no_bytes,
        }  # fmt: skip
        # numpy 1 and 2, Python 2 and 3 name the same functions differently
        self.allowed: dict[str, Names] = {
            "numpy": {"ndarray": None, "dtype": self._dtype},
            "numpy.core.multiarray": array,
            "numpy._core.multiarray": array,
            "numpy.core.numeric": buffer,
            "numpy._core.numeric": buffer,
            "collections": {"OrderedDict": self._ordered, "defaultdict": self._default},
            "_codecs": {"encode": self._encode},  # how protocol 2 spells bytes
            # HOLD saves some arrays as tensors
            "torch._utils": {"_rebuild_tensor_v2": self._tensor},
            "torch.storage": {"_load_from_bytes": self._storage},
            "builtins": plain,
            "__builtin__": plain,
        }

    def named(self, module: str, name: str) -> Named:
        """What stands for a name; UnpicklingError for one that is not allowed."""
        known = self.allowed.get(module, {})
        if name not in known:
            raise refused(
                f"it contains {module}.{name}; only numbers, arrays, lists and dictionaries "
                "are allowed, so save only these"
            )
        return Named(f"{module}.{name}", known[name])

    def call(self, function: Any, arguments: Any) -> Any:
        """REDUCE."""
        if type(function) is not Named or function.make is None or type(arguments) is not tuple:
            called = function.name if type(function) is Named else type(function).__name__
            raise refused(f"it calls {called}, which is no function that makes numbers")
        return function.make(*arguments)

    def build(self, made: Any, state: Any) -> None:
        """BUILD, of an array or a dtype that was just made."""
        if type(made) is Dtype:
            self._set_order(made, state)
        elif self._unfilled.pop(id(made), None) is not None:
            self._fill(made, state)
        else:
            raise refused(f"it gives a state to a {type(made).__name__}")

    def spend(self, count: int) -> None:
        """Count bytes that are made; UnpicklingError for more than the file may make."""
        self.left -= count
        if self.left < 0:
            raise refused(f"its {self.size} bytes unfold to more than {self.most / 2**30:.2g} GiB")

    def array(
        self, shape: Any, dtype: Any, content: Any, order: Literal["C", "F"] = "C"
    ) -> np.ndarray:
        """An array over just its bytes.

        Raises:
            UnpicklingError: it is not of numbers or texts, or its size is not that of `content`.
        """
        kind = self._checked(shape, dtype, content)
        return np.ndarray(shape, kind, content, order=order)

    def nbytes(self, shape: Any, dtype: Any) -> int:
        """How many bytes an array has whose shape and dtype a file claims."""
        if type(dtype) is not Dtype or dtype.code == "O":
            raise refused(f"it holds an array of {_kind(dtype)}; save numbers")
        sizes = self._sizes(shape)
        return math.prod(sizes) * dtype.numpy.itemsize

    def _sizes(self, shape: Any) -> tuple[int, ...]:
        """A shape that is one; of an array of nothing, with no more rows than a file may have."""
        whole = type(shape) is tuple and len(shape) <= MOST_AXES
        if not whole or any(type(n) is not int or n < 0 for n in shape):
            raise refused(f"an array has the shape {shape!r:.80}")
        rows = math.prod(max(n, 1) for n in shape)
        if rows > max(self.size, EMPTY_ROWS):
            raise refused(f"an array of shape {shape} cannot be in a file of {self.size} bytes")
        return shape

    def _checked(self, shape: Any, dtype: Any, content: Any) -> np.dtype:
        nbytes = self.nbytes(shape, dtype)
        if type(content) not in (bytes, bytearray) or len(content) != nbytes:
            found = f"{len(content)} bytes" if hasattr(content, "__len__") else "none"
            raise refused(f"an array of shape {shape} has {found} of {nbytes}")
        kind: np.dtype = dtype.numpy
        if kind.kind == "U" and nbytes:
            points = np.frombuffer(content, np.dtype(kind.byteorder + "u4"))
            if points.max() > sys.maxunicode:
                raise refused(f"an array of texts has the character {points.max()}")
        return kind

    # numpy

    def _dtype(self, code: Any, align: Any = False, copy: Any = True) -> Dtype:
        if code in ("O", "O8", "O4"):
            return Dtype("O")
        if type(code) is not str or not (
            code in _DTYPES or (code[:1] in ("S", "U") and code[1:].isdecimal() and len(code) < 10)
        ):
            raise refused(f"it holds an array of the dtype {code!r:.80}; save numbers")
        return Dtype(code)

    def _set_order(self, made: Dtype, state: Any) -> None:
        """Of (3, byte order, subarray, names, fields, item size, alignment, flags)."""
        plain = type(state) is tuple and len(state) == 8 and state[2:5] == (None, None, None)
        if not plain or state[1] not in ("<", ">", "|", "="):
            raise refused(f"it holds an array of a dtype with the state {state!r:.80}")
        made.order = state[1]

    def _reconstruct(self, kind: Any, shape: Any = (0,), code: Any = b"b") -> np.ndarray:
        _require_array_type(kind)
        if shape != (0,):
            raise refused(f"numpy's _reconstruct has the shape {shape!r:.80}")
        blank = np.empty(0, np.int8)
        self._unfilled[id(blank)] = blank
        return blank

    def _fill(self, array: np.ndarray, state: Any) -> None:
        """Of (1, shape, dtype, whether in Fortran's order, bytes or a list)."""
        if type(state) is not tuple or len(state) != 5:
            raise refused(f"an array has the state {state!r:.80}")
        version, shape, dtype, fortran, content = state
        if version != 1 or type(fortran) not in (bool, int):
            raise refused(f"an array has a state of version {version!r:.80}")
        if type(dtype) is Dtype and dtype.code == "O":  # numpy.save makes one of a dictionary
            if type(content) is not list or len(content) != math.prod(self._sizes(shape)):
                raise refused(f"an array of shape {shape} has other than so many objects")
            kind, content = np.dtype("O"), list(content)
        else:
            if type(content) is str:  # of Python 2
                content = content.encode("latin1")
            kind, content = self._checked(shape, dtype, content), bytes(content)
        self.spend(8 * len(content) if kind.hasobject else len(content))
        array.__setstate__((1, shape, kind, bool(fortran), content))  # type: ignore[arg-type]

    def _scalar(self, dtype: Any, content: Any = b"") -> Any:
        if type(content) is str:  # of Python 2
            content = content.encode("latin1")
        return self.array((), dtype, content)[()]

    def _frombuffer(
        self, content: Any, dtype: Any, shape: Any, order: Any, axes: Any = None
    ) -> np.ndarray:
        if order == "K" and axes is not None:
            array = self.array(shape, dtype, content)
            if type(axes) is not tuple or sorted(axes) != list(range(array.ndim)):
                raise refused(f"an array of shape {shape} has the axes {axes!r:.80}")
            return array.transpose(axes)
        if order not in ("C", "F"):
            raise refused(f"an array has the order {order!r:.80}")
        return self.array(shape, dtype, content, order)

    # Python

    def _ordered(self, items: Any = ()) -> dict[Any, Any]:
        """A plain dictionary: they all keep their order. Python 2 gives its items as lists."""
        if type(items) not in (tuple, list):
            raise refused(f"a dictionary is made of a {type(items).__name__}")
        self.spend(64 * len(items))
        if any(type(i) not in (tuple, list) or len(i) != 2 or not is_key(i[0]) for i in items):
            raise refused("a dictionary is made of other than pairs of a text or number and more")
        return dict(items)

    def _default(self, factory: Any = None) -> dict[Any, Any]:
        """A plain dictionary: a key that is absent is an error, and not a new entry."""
        return {}

    def make_set(self, items: Any = ()) -> set[Any]:
        if type(items) not in (tuple, list) or not all(map(is_key, items)):
            raise refused(f"a set is made of a {_kind(items)} of other than texts and numbers")
        self.spend(sys.getsizeof(set()) + 64 * len(items))
        return set(items)

    def _frozenset(self, items: Any = ()) -> frozenset[Any]:
        return frozenset(self.make_set(items))

    def _complex(self, real: Any, imaginary: Any = 0.0) -> complex:
        if type(real) is not float or type(imaginary) is not float:
            raise refused("a complex number is made of other than two numbers")
        return complex(real, imaginary)

    def _no_bytes(self) -> bytes:
        return b""

    def _encode(self, text: Any, encoding: Any = "") -> bytes:
        if type(text) is not str or encoding not in _LATIN:
            raise refused(f"it encodes a {type(text).__name__} as {encoding!r:.80}")
        self.spend(len(text))
        return text.encode("latin1")

    # torch

    def _storage(self, content: Any) -> Any:
        """The numbers of a tensor; torch's own function would unpickle them without any check.

        Onto the CPU: the authors may have saved them from a GPU that is not here.
        """
        import torch

        if type(content) is not bytes or content[:1] != pickle.PROTO:  # else it may be a zip
            raise refused(f"the numbers of a tensor are other than torch.save's {_kind(content)}")
        self.spend(len(content))
        found = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
        if type(found) is not torch.storage.TypedStorage:
            raise refused(f"the numbers of a tensor are a {type(found).__name__}")
        numbers = found._untyped_storage  # its public methods warn that they will go
        self.spend(numbers.nbytes())
        return torch.empty(0, dtype=found.dtype).set_(numbers)

    def _tensor(self, storage: Any, offset: Any, shape: Any, strides: Any, *_: Any) -> Any:
        """A tensor in its storage, of which it may hold a number many times, as `expand` does."""
        import torch

        if type(storage) is not torch.Tensor or storage.dim() != 1:
            raise refused(f"the storage of a tensor is a {_kind(storage)}")
        sizes = self._sizes(shape)
        steps = type(strides) is tuple and all(type(n) is int and n >= 0 for n in strides)
        if not steps or len(strides) != len(sizes) or type(offset) is not int or offset < 0:
            raise refused(f"a tensor of shape {shape} has the strides {strides!r:.80}")
        return storage.as_strided(sizes, strides, offset)  # torch checks that it is within


def _require_array_type(kind: Any) -> None:
    if type(kind) is not Named or kind.name != "numpy.ndarray":
        raise refused(f"an array is of the class {_kind(kind)}")


def _kind(value: Any) -> str:
    if type(value) is Dtype:
        return "Python objects" if value.code == "O" else value.code
    return value.name if type(value) is Named else type(value).__name__


_PythonUnpickler: Any = pickle._Unpickler  # the C version cannot be extended
# Opcodes that Python's unpickler may do as it does.
_PLAIN = (
    "PROTO", "STOP", "MARK", "POP", "POP_MARK", "DUP", "GET", "BINGET", "LONG_BINGET", "PUT",
    "BINPUT", "LONG_BINPUT", "MEMOIZE", "NONE", "NEWTRUE", "NEWFALSE", "BININT", "BININT1",
    "BININT2", "FLOAT", "BINFLOAT", "STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE",
    "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8",
    "EMPTY_LIST", "LIST", "EMPTY_TUPLE", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3", "EMPTY_DICT",
    "GLOBAL", "STACK_GLOBAL",
)  # fmt: skip
_INTEGERS = ("INT", "LONG", "LONG1", "LONG4")  # so may these, of at most 64 bits
# Those that are done here; all others are refused.
_OWN = (
    "FRAME", "BYTEARRAY8", "APPEND", "APPENDS", "SETITEM",
    "SETITEMS", "DICT", "EMPTY_SET", "ADDITEMS", "FROZENSET", "REDUCE", "BUILD",
)  # fmt: skip


class Opcodes(dict[int, Callable[[Any], None]]):
    """What is done for each opcode; UnpicklingError for others."""

    def __missing__(self, code: int) -> Callable[[Any], None]:
        known = next((op for op in pickletools.opcodes if ord(op.code) == code), None)
        what = f"the opcode {known.name}" if known else f"the byte {code}, which is no opcode,"
        raise refused(f"it holds {what} where numbers, arrays, lists or dictionaries are expected")


class Unpickler(_PythonUnpickler):  # type: ignore[misc]  # which is Any
    """Reads one pickle of plain values and arrays.

    Args:
        size: of the whole file, bytes; what it makes is in proportion.
    """

    dispatch: ClassVar[Opcodes] = Opcodes()

    def __init__(self, content: io.BytesIO, size: int) -> None:
        super().__init__(content, encoding="latin1")
        self.content = content
        self.calls = Calls(size)

    def load(self) -> Any:
        found = super().load()
        _weigh(found, self.calls.most)
        return found

    def find_class(self, module: str, name: str) -> Any:
        return self.calls.named(module, name)

    def load_frame(self) -> None:
        self.read(8)  # its size, which says how much to read ahead; all of it is in memory

    def load_bytearray8(self) -> None:
        size = int.from_bytes(self.read(8), "little")
        self.append(bytearray(self.read(size)))  # Python takes memory for `size` first

    def load_append(self) -> None:
        value = self.stack.pop()
        self._last(list).append(value)

    def load_appends(self) -> None:
        items = self.pop_mark()
        self._last(list).extend(items)

    def load_setitem(self) -> None:
        value, key = self.stack.pop(), self.stack.pop()
        self._set_items([key, value])

    def load_setitems(self) -> None:
        self._set_items(self.pop_mark())

    def load_dict(self) -> None:
        items = self.pop_mark()
        self.append({})
        self._set_items(items)

    def _set_items(self, items: list[Any]) -> None:
        keys, values = items[::2], items[1::2]
        if len(keys) != len(values) or not all(map(is_key, keys)):
            raise refused("a dictionary has keys that are no text or number, or lacks a value")
        self._last(dict).update(zip(keys, values))

    def load_empty_set(self) -> None:
        self.append(self.calls.make_set())

    def load_additems(self) -> None:
        items = self.pop_mark()
        self._last(set).update(self.calls.make_set(items))

    def load_frozenset(self) -> None:
        items = self.pop_mark()
        self.append(frozenset(self.calls.make_set(items)))

    def load_reduce(self) -> None:
        arguments = self.stack.pop()
        self.stack[-1] = self.calls.call(self.stack[-1], arguments)

    def load_build(self) -> None:
        state = self.stack.pop()
        self.calls.build(self.stack[-1], state)

    def _last(self, kind: type) -> Any:
        """What items are put into, which is just such a thing: to others they do more."""
        last = self.stack[-1]
        if type(last) is not kind:
            raise refused(f"it puts items into a {type(last).__name__} as into a {kind.__name__}")
        return last


def _of_few_bits(load: Callable[[Any], None]) -> Callable[[Any], None]:
    """An opcode of an integer; longer ones are no numbers of an array, and collide in
    dictionaries."""

    def checked(unpickler: Any) -> None:
        load(unpickler)
        if (bits := unpickler.stack[-1].bit_length()) > 64:
            raise refused(f"it holds an integer of {bits} bits; expected at most 64")

    return checked


for _name in (*_PLAIN, *_INTEGERS):
    _code = getattr(pickle, _name)[0]
    _plain = _PythonUnpickler.dispatch[_code]
    Unpickler.dispatch[_code] = _of_few_bits(_plain) if _name in _INTEGERS else _plain
for _name in _OWN:
    Unpickler.dispatch[getattr(pickle, _name)[0]] = getattr(Unpickler, f"load_{_name.lower()}")


def _weigh(value: Any, most: int) -> None:
    """UnpicklingError for what is no number, text, array or holder of these, or is too large.

    What is held in many places counts in each: a few bytes make lists of lists of lists, each a
    thousand times the same, which no program ends to go through.
    """
    known: dict[int, tuple[int, int]] = {}  # of holders by id: bytes, and levels below

    def weight(value: Any, depth: int) -> tuple[int, int]:
        if (size := _size(value)) is not None:
            return size, 0
        if id(value) in known:
            size, below = known[id(value)]
        else:
            size, below = 8, 0
            for item in _items(value) if depth < DEEPEST else ():
                more, levels = weight(item, depth + 1)
                size, below = size + more, max(below, levels + 1)
                if size > most:
                    raise refused(f"its values unfold to more than {most / 2**30:.2g} GiB")
            if below:  # what is empty is quick to look at again
                known[id(value)] = size, below
        if depth + below >= DEEPEST:
            raise refused(f"its lists are nested {DEEPEST} deep, or hold themselves")
        return size, below

    weight(value, 0)


def _size(value: Any) -> int | None:
    """Bytes of a number, text or array; None of what may hold some."""
    kind = type(value)
    if value is None or kind in (bool, int, float, complex):
        return 8
    if kind in (str, bytes, bytearray):
        return 8 + len(value)
    if (kind is np.ndarray and not value.dtype.hasobject) or isinstance(value, np.generic):
        return int(value.nbytes)
    torch = sys.modules.get("torch")  # which `Calls` has loaded if there is a tensor
    if torch is not None and kind is torch.Tensor:
        return int(value.nbytes)
    return None


def _items(value: Any) -> Iterable[Any]:
    if type(value) in (list, tuple, set, frozenset):
        return value
    if type(value) is dict:
        return chain(value, value.values())
    if type(value) is np.ndarray:  # of objects
        return value.ravel()
    name = value.name if type(value) is Named else type(value).__name__
    raise refused(f"it holds {name} as a value; save numbers, arrays, lists and dictionaries")


def load_pickle(path: Path) -> Any:
    """The content of a .pkl of plain values and numpy arrays, written by Python 2 or 3.

    Dictionaries of every class come as `dict`.

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
            header = read_header(file, path.name)
            if not header.dtype.hasobject:
                return load_array(path)
        # numpy reads a header that is no literal token by token, as Python 2 wrote it
        except (ValueError, KeyError, EOFError, OverflowError, TokenError) as error:
            raise ClipError(f"{path} is not a readable .npy file ({error})") from error
        array = _load(file, path)
    if type(array) is not np.ndarray or array.shape != header.shape:
        found = type(array).__name__
        raise ClipError(f"{path} holds a {found}, expected an array of shape {header.shape}")
    return array.item() if header.shape == () else array


def _load(file: IO[bytes], path: Path) -> Any:
    try:
        content = file.read()
        return Unpickler(io.BytesIO(content), len(content)).load()
    except Exception as error:  # a damaged pickle raises anything
        raise ClipError(f"{path} cannot be read: {error or type(error).__name__}") from error
