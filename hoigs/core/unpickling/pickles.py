"""Pickled dictionaries of data sets and programs, read without running any code in them.

Python's own loader calls any function that a pickle names, and gives any object a state, items or
attributes. Here a pickle makes numbers, texts, arrays, lists and dictionaries: `calls` has the
functions that it may name, and of the opcodes only those are done that such values are written
with. What comes out is looked through once more.
"""

from __future__ import annotations

import io
import pickle
import pickletools
import sys
from collections.abc import Callable, Iterable
from itertools import chain
from pathlib import Path
from tokenize import TokenError
from typing import IO, Any, ClassVar

import numpy as np

from hoigs.core.errors import ClipError
from hoigs.core.files.npz import load_array, read_header
from hoigs.core.files.regular_file import regular_file
from hoigs.core.unpickling.calls import DEEPEST, Calls, Named, is_key, refused

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
# Those that are done here; all others are refused.
_OWN = (
    "FRAME", "INT", "LONG", "LONG1", "LONG4", "BYTEARRAY8", "APPEND", "APPENDS", "SETITEM",
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

    def load_int(self) -> None:
        super().load_int()
        self._check_bits()

    def load_long(self) -> None:
        super().load_long()
        self._check_bits()

    def load_long1(self) -> None:
        super().load_long1()
        self._check_bits()

    def load_long4(self) -> None:
        super().load_long4()
        self._check_bits()

    def _check_bits(self) -> None:
        """Longer ones are no numbers of an array, and collide in dictionaries."""
        if (bits := self.stack[-1].bit_length()) > 64:
            raise refused(f"it holds an integer of {bits} bits; expected at most 64")

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


for _name in _PLAIN:
    _code = getattr(pickle, _name)[0]
    Unpickler.dispatch[_code] = _PythonUnpickler.dispatch[_code]
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
