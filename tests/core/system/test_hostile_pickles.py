"""Pickles that were made to run code, to end the process or to take its memory are refused.

They are put together here opcode by opcode: pickle itself would not write most of them.
"""

from __future__ import annotations

import io
import pickle
import random
import struct
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

from hoigs.core.errors import ClipError
from hoigs.core.system.joblib_file import load_joblib
from hoigs.core.system.unpickling import Calls, load_pickle


class Name(NamedTuple):
    """A class or function by its name."""

    module: str
    name: str


class Made(NamedTuple):
    """What a call makes, or NEWOBJ does without arguments, and a state that it is given."""

    function: Any
    arguments: Any
    state: Any = None
    opcode: bytes = pickle.REDUCE


def written(value: Any) -> bytes:
    """The opcodes that make a value."""
    if isinstance(value, Name):
        return b"c%s\n%s\n" % (value.module.encode(), value.name.encode())
    if isinstance(value, Made):
        state = b"" if value.state is None else written(value.state) + pickle.BUILD
        return written(value.function) + written(value.arguments) + value.opcode + state
    if isinstance(value, tuple):
        return pickle.MARK + b"".join(map(written, value)) + pickle.TUPLE
    if isinstance(value, list):
        return pickle.MARK + b"".join(map(written, value)) + pickle.LIST
    return pickle.dumps(value, 3)[2:-1]


def read(path: Path, opcodes: bytes, load: Callable[[Path], Any] = load_pickle) -> Any:
    path.write_bytes(opcodes + pickle.STOP)
    return load(path)


NDARRAY = Name("numpy", "ndarray")
BLANK = (NDARRAY, (0,), b"b")
RECONSTRUCT = Name("numpy._core.multiarray", "_reconstruct")
STATE = (3, "<", None, None, None, -1, -1, 0)


def dtype(code: str) -> Made:
    return Made(Name("numpy", "dtype"), (code, False, True), STATE)


def storage() -> Made:
    content = io.BytesIO()
    numbers = torch.arange(6.0)._typed_storage()
    torch.save(numbers, content, _use_new_zipfile_serialization=False)
    return Made(Name("torch.storage", "_load_from_bytes"), (content.getvalue(),))


def calls() -> dict[str, Made]:
    """A right call of each function that may be called."""
    array = Made(RECONSTRUCT, BLANK, (1, (3,), dtype("f8"), False, bytes(24)))
    scalar = Made(Name("numpy._core.multiarray", "scalar"), (dtype("f4"), bytes(4)))
    buffer = Made(
        Name("numpy._core.numeric", "_frombuffer"), (bytes(24), dtype("i4"), (2, 3), "K", (1, 0))
    )
    made = [
        dtype("f8"), array, scalar, buffer, storage(),
        array._replace(function=Name("numpy.core.multiarray", "_reconstruct")),
        scalar._replace(function=Name("numpy.core.multiarray", "scalar")),
        buffer._replace(function=Name("numpy.core.numeric", "_frombuffer")),
        Made(Name("collections", "OrderedDict"), ([["a", 1], ["b", 2]],)),
        Made(Name("collections", "defaultdict"), (Name("builtins", "dict"),)),
        Made(Name("_codecs", "encode"), ("ab", "latin1")),
        Made(Name("torch._utils", "_rebuild_tensor_v2"), (storage(), 0, (2, 3), (3, 1), False, ())),
    ]  # fmt: skip
    for module in ("builtins", "__builtin__"):
        made += [
            Made(Name(module, "set"), ([1, "a"],)), Made(Name(module, "frozenset"), ([1, "a"],)),
            Made(Name(module, "complex"), (1.0, 2.0)), Made(Name(module, "bytes"), ()),
        ]  # fmt: skip
    return {".".join(one.function): one for one in made}


ODD = [
    None, True, -1, 0, 1, 10**6, 2**62, -(2**62), 1e300, float("nan"), "", "O", "V8", "f8", "M8[s]",
    "U9999999", "latin1", "zlib", ">", "F", b"", bytes(24), b"A" * 24, b"\xff" * 8, (), (3,), (-3,),
    (2**62,), (10**6, 10**6), (2**62, 0), (1,) * 40, (0, 0), [], [1, [2]], [(1, 2)], {}, {"a": 1},
    NDARRAY, RECONSTRUCT, Name("builtins", "dict"), Name("builtins", "set"), dtype("O"),
    dtype("f8"), dtype("U3"), Made(RECONSTRUCT, BLANK),
    Made(RECONSTRUCT, BLANK, (1, (1,), dtype("O"), False, [[1]])),
]  # fmt: skip


def mutated(value: Any, rng: random.Random) -> Any:
    """Something in it replaced, left out or held twice."""
    if not isinstance(value, tuple | list) or isinstance(value, Name) or rng.random() < 0.15:
        return rng.choice(ODD)
    parts = list(value)
    if isinstance(value, Made):
        at = rng.choice((1, 2) if value.state is not None else (1, 1, 2))
        parts[at] = mutated(parts[at], rng)
        return Made(*parts)
    if not parts or rng.random() < 0.2:
        parts.insert(rng.randint(0, len(parts)), rng.choice(ODD))
    elif rng.random() < 0.1:
        del parts[rng.randrange(len(parts))]
    else:
        at = rng.randrange(len(parts))
        parts[at] = mutated(parts[at], rng)
    return type(value)(parts)


def plain(value: Any) -> bool:
    """Whether it is of numbers, texts and holders of these alone."""
    if isinstance(value, dict):
        return type(value) is dict and plain([*value, *value.values()])
    if isinstance(value, list | tuple | set | frozenset):
        return all(map(plain, value))
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist()) if value.dtype == object else value.dtype.kind in "biufcSU"
    known = (int, float, complex, str, bytes, bytearray, torch.Tensor)
    return value is None or isinstance(value, known)


def fuzz(right: Made, path: Path, load: Callable[[Path], Any], after: bytes = b"") -> None:
    """300 mutations of a call are refused, or make plain values of the file's own size."""
    rng = random.Random(path.name)
    began, made, refused = time.monotonic(), 0, 0
    tracemalloc.start()
    try:
        for _ in range(300):
            wrong = right
            for _ in range(rng.choice((1, 1, 2, 3))):
                wrong = mutated(wrong, rng)
            try:
                assert plain(read(path, written(wrong) + after, load))
                made += 1
            except ClipError as error:
                assert path.name in str(error)
                refused += 1
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert refused and made + refused == 300
    assert peak < 2**24 and time.monotonic() - began < 60


def test_each_function_that_is_allowed_is_fuzzed() -> None:
    allowed = Calls(0).allowed
    called = {f"{m}.{n}" for m, names in allowed.items() for n, make in names.items() if make}
    assert called == set(calls())


@pytest.mark.parametrize("name", sorted(calls()))
def test_a_function_makes_plain_values_whatever_its_arguments(tmp_path: Path, name: str) -> None:
    right = calls()[name]
    if name != "numpy.dtype":  # which is no value
        assert plain(read(tmp_path / "right.pkl", written(right)))
    fuzz(right, tmp_path / f"{name}.pkl", load_pickle)


def test_arrays_of_joblib_are_plain_whatever_their_state(tmp_path: Path) -> None:
    kind = Name("joblib.numpy_pickle", "NumpyArrayWrapper")
    state = {"shape": (3,), "order": "C", "dtype": 0, "numpy_array_alignment_bytes": 16}
    rng = random.Random(0)
    for _ in range(300):
        values = {
            **state, "shape": rng.choice(((3,), *ODD)), "dtype": rng.choice((dtype("f8"), *ODD))
        }  # fmt: skip
        items = b"".join(written(k) + written(v) for k, v in values.items())
        opcodes = written(kind) + b")\x81}(" + items + b"ub"
        try:
            assert plain(read(tmp_path / "x.pkl", opcodes + b"\x00" + bytes(24), load_joblib))
        except ClipError as error:
            assert "x.pkl" in str(error)


def doubled(times: int, holder: bytes) -> bytes:
    """A list or tuple that holds another twice, and so on."""
    return b"]" + times * (b"q\x000(h\x00h\x00" + holder)


ARRAY = written(Made(RECONSTRUCT, BLANK, (1, (3,), dtype("u1"), False, bytes(3))))


@pytest.mark.parametrize(
    ("opcodes", "fact"),
    [
        (written(Made(NDARRAY, ((3,), dtype("O"), b"A" * 24))), "numpy.ndarray"),
        (written(Made(RECONSTRUCT, BLANK, (1, (3,), dtype("O"), False, b"A" * 24))), "objects"),
        (written(Made(RECONSTRUCT, BLANK, (1, (2,), dtype("O"), False, [1]))), "objects"),
        (written(Made(RECONSTRUCT, BLANK, (1, (2**40,), dtype("f8"), False, b""))), str(2**40)),
        (written(Made(RECONSTRUCT, BLANK, (1, (2**40, 0), dtype("f8"), False, b""))), str(2**40)),
        (
            written(Made(RECONSTRUCT, BLANK, (1, (1,), dtype("U1"), False, b"\xff" * 4))),
            "character",
        ),
        (written(dtype("V8")), "V8"),
        (written(dtype("M8[s]")), "M8"),
        (written(Made(Name("builtins", "set"), (Made(Name("builtins", "range"), (9,)),))), "range"),
        (written(Made(Name("builtins", "bytearray"), (10**9,))), "bytearray"),
        (written(Made(Name("_codecs", "encode"), ("a" * 99, "idna"))), "idna"),
        (written(Made(storage().function, (storage(),))), "tensor"),
        (
            written(Made(Name("torch._utils", "_rebuild_tensor_v2"),
                         (storage(), 0, (10**4, 10**4), (0, 0), False, ()))), "10000"
        ),
        (written(Made(Name("torch._utils", "_rebuild_tensor_v2"),
                      (storage(), 4, (3,), (1,), False, ()))), "out of bounds"),
        (ARRAY + b"K\x00K\x07s", "ndarray"),  # SETITEM
        (ARRAY + b"(K\x00K\x07u", "ndarray"),
        (ARRAY + b"K\x07a", "ndarray"),  # APPEND
        (b"](K\x07\x90", "list"),  # ADDITEMS
        (b"\x8f(K\x07e", "set"),  # APPENDS
        (written([1]) + written({"a": 1}) + b"b", "list"),  # BUILD
        (written(NDARRAY) + written({"a": 1}) + b"b", "Named"),
        (ARRAY + written((1, (3,), dtype("u1"), False, bytes(3))) + b"b", "ndarray"),  # once more
        (written(NDARRAY), "numpy.ndarray"),  # as a value
        (written(dtype("f8")), "Dtype"),
        (b"}" + doubled(60, b"t") + b"K\x07s", "keys"),  # hashed for ever
        (b"(" + doubled(60, b"t") + b"\x91", "set"),
        (doubled(60, b"l"), "GiB"),
        (b"]" * 1000 + b"a" * 999, "nested"),
        (b"]q\x00h\x00a", "nested"),  # in itself
        (b"]q\x00(h\x00h\x00h\x00e", "nested"),
        (b"\x8b" + struct.pack("<i", 10**6) + b"\x7f" * 10**6, "bits"),  # LONG4
        (b"L0x" + b"f" * 10**6 + b"L\n", "bits"),
        (b"\x96" + struct.pack("<Q", 2**40), "x.pkl"),  # BYTEARRAY8
        (b"\x8e" + struct.pack("<Q", 2**40), "x.pkl"),  # BINBYTES8
        (b"\x95" + struct.pack("<Q", 2**60) + b"N" * 9 + b"0" * 20, "x.pkl"),  # FRAME
        (b"Nr" + b"\xff" * 4 + b"0", "x.pkl"),  # LONG_BINPUT: C's makes a table of that size
        (b"\x97", "NEXT_BUFFER"),
        (b"C\x01a\x98", "READONLY_BUFFER"),
        (b"Pa\n", "PERSID"),
        (b"NQ", "BINPERSID"),
        (b"\x82\x01", "EXT1"),
        (b"(icollections\nOrderedDict\n", "INST"),
        (b"(" + written(Name("collections", "OrderedDict")) + b"o", "OBJ"),
        (written(Name("collections", "OrderedDict")) + b")\x81", "NEWOBJ"),
        (written(Name("collections", "OrderedDict")) + b")}\x92", "NEWOBJ_EX"),
        (b"\xff", "255"),
    ],
)  # fmt: skip
def test_what_attacks_is_refused_at_once(tmp_path: Path, opcodes: bytes, fact: str) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(ClipError, match=fact):
            read(tmp_path / "x.pkl", opcodes)
        assert tracemalloc.get_traced_memory()[1] < 2**24
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    "opcodes",
    [
        b"(" + b"\x8f" * 10**4 + b"l",  # sets
        written([*range(1000)]) + b"q\x00(" + 99 * (b"c__builtin__\nset\nh\x00\x85R"),
        written("a" * 10**5) + b"q\x00(" + 99 * (b"c_codecs\nencode\nh\x00S'latin1'\n\x86R"),
    ],
)  # fmt: skip
def test_what_is_made_again_and_again_is_bounded_by_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, opcodes: bytes
) -> None:
    monkeypatch.setattr("hoigs.core.system.unpickling.SMALL_BYTES", 2**20)
    monkeypatch.setattr("hoigs.core.system.unpickling.MOST_RATIO", 10)
    with pytest.raises(ClipError, match=f"{len(opcodes) + 1} bytes unfold to more than"):
        read(tmp_path / "x.pkl", opcodes)
