"""Pickled dictionaries are read; code in them is not run."""

from __future__ import annotations

import io
import pickle
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import torch

from hoigs.core.errors import ClipError
from hoigs.core.unpickling.pickles import ALLOWED, load_pickle, load_pickled_npy

VALUE = {
    "a": {"K": np.eye(3), "s": np.float32(2.5), "name": "x", "ids": [1, 2], "raw": b"\x00\xff"},
    "b": np.arange(6).reshape(2, 3)[:, ::-1],
}


class Evil:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return eval, ("open('ran', 'w')",)


@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4, 5])
def test_values_come_back(tmp_path: Path, protocol: int) -> None:
    (tmp_path / "x.pkl").write_bytes(pickle.dumps(VALUE, protocol=protocol))
    back = load_pickle(tmp_path / "x.pkl")
    np.testing.assert_array_equal(back["b"], VALUE["b"])
    np.testing.assert_array_equal(back["a"]["K"], np.eye(3))
    assert back["a"]["s"] == 2.5 and back["a"]["ids"] == [1, 2] and back["a"]["raw"] == b"\x00\xff"


def test_npy_with_a_dictionary_and_with_numbers(tmp_path: Path) -> None:
    np.save(tmp_path / "d.npy", VALUE, allow_pickle=True)
    assert load_pickled_npy(tmp_path / "d.npy")["a"]["name"] == "x"
    np.save(tmp_path / "n.npy", np.arange(3))
    np.testing.assert_array_equal(load_pickled_npy(tmp_path / "n.npy"), np.arange(3))
    np.save(tmp_path / "o.npy", np.array([{"a": 1}, {"a": 2}], dtype=object), allow_pickle=True)
    assert load_pickled_npy(tmp_path / "o.npy")[1] == {"a": 2}


def test_tensors_come_back_and_carry_no_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    value = torch.arange(6.0).reshape(2, 3).T
    np.save(tmp_path / "t.npy", {"norm_mat": value}, allow_pickle=True)
    assert load_pickled_npy(tmp_path / "t.npy")["norm_mat"].equal(value)
    buffer = io.BytesIO()
    torch.save(Evil(), buffer)

    class Hidden:
        def __reduce__(self) -> tuple[object, tuple[bytes]]:
            return torch.storage._load_from_bytes, (buffer.getvalue(),)

    (tmp_path / "x.pkl").write_bytes(pickle.dumps(Hidden()))
    with pytest.raises(ClipError, match=r"x\.pkl cannot be read"):
        load_pickle(tmp_path / "x.pkl")
    assert not (tmp_path / "ran").exists()


def test_code_is_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "x.pkl").write_bytes(pickle.dumps({"a": Evil()}))
    np.save(tmp_path / "x.npy", {"a": Evil()}, allow_pickle=True)
    with pytest.raises(ClipError, match=r"x\.pkl cannot be read: it contains builtins\.eval"):
        load_pickle(tmp_path / "x.pkl")
    with pytest.raises(ClipError, match=r"x\.npy cannot be read: it contains builtins\.eval"):
        load_pickled_npy(tmp_path / "x.npy")
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("content", [b"", b"nonsense", pickle.dumps(VALUE)[:-20]])
def test_damage_is_told(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "x.pkl").write_bytes(content)
    (tmp_path / "x.npy").write_bytes(content)
    with pytest.raises(ClipError, match=r"x\.pkl cannot be read"):
        load_pickle(tmp_path / "x.pkl")
    with pytest.raises(ClipError, match=r"x\.npy is not a readable"):
        load_pickled_npy(tmp_path / "x.npy")


def test_a_header_without_its_bracket_is_told(tmp_path: Path) -> None:
    np.save(tmp_path / "x.npy", np.zeros((12, 7)))
    content = (tmp_path / "x.npy").read_bytes()
    (tmp_path / "x.npy").write_bytes(content.replace(b"'shape': (12", b"'shape': \xcc12"))
    with pytest.raises(ClipError, match=r"x\.npy is not a readable"):
        load_pickled_npy(tmp_path / "x.npy")


class Named:
    """A function by name, called by the pickle; it need not exist here."""

    def __init__(self, module: str, name: str, *args: object) -> None:
        self.module, self.name, self.args = module, name, args

    def pickled(self) -> bytes:
        body = b"".join(value(x) for x in self.args)
        return f"c{self.module}\n{self.name}\n".encode() + b"(" + body + b"tR"


def value(x: object) -> bytes:
    """Instructions that make a value, without the frame around them."""
    if isinstance(x, Named):
        return x.pickled()
    if isinstance(x, tuple):
        return b"(" + b"".join(value(y) for y in x) + b"t"
    return pickle.dumps(x, 2)[2:-1]


def file_of(x: object, path: Path) -> Path:
    path.write_bytes(b"\x80\x04" + value(x) + b".")
    return path


DTYPE = ("numpy", "dtype")
HOSTILE = {
    "objects over bytes": Named("numpy", "ndarray", (3,), Named(*DTYPE, "O"), bytearray(24)),
    "void": Named("numpy.core.multiarray", "scalar", Named(*DTYPE, "V8"), bytes(8)),
    "records": Named(*DTYPE, [("a", "O")]),
    "object scalar": Named("numpy.core.multiarray", "scalar", Named(*DTYPE, "O8"), bytes(8)),
    "frombuffer of objects": Named(
        "numpy._core.numeric", "_frombuffer", bytes(8), Named(*DTYPE, "O"), (1,), "C"
    ),
    "set of a long range": Named("builtins", "set", Named("builtins", "range", 10**11)),
    "frozenset of a range": Named("builtins", "frozenset", Named("builtins", "range", 10**6)),
    "bytearray of a number": Named("builtins", "bytearray", 10**11),
    "array of another class": Named(
        "numpy.core.multiarray", "_reconstruct", Named("builtins", "dict"), (0,), b"b"
    ),
    "a call of a value": (),  # replaced below: REDUCE on a dict
}


@pytest.mark.parametrize("name", HOSTILE)
def test_what_asks_for_more_than_it_holds_is_refused(tmp_path: Path, name: str) -> None:
    path = file_of(HOSTILE[name], tmp_path / "x.pkl")
    if name == "a call of a value":
        path.write_bytes(b"\x80\x04}(tR.")
    with pytest.raises(ClipError, match=r"x\.pkl"):
        load_pickle(path)


@pytest.mark.parametrize(
    "body",
    [
        pickle.dumps(np.zeros(3), 4).replace(b"K\x03\x85", b"K\x7f\x85"),  # a longer shape
        b"\x80\x04](K\x01K\x02s.",  # SETITEM on a list
        b"\x80\x04}K\x01a.",  # APPEND to a dictionary
        b"\x80\x04cbuiltins\nset\n(tR}b.",  # BUILD on a set
        b"\x80\x04\x82\x01.",  # EXT1
        b"\x80\x04X\x01\x00\x00\x00xQ.",  # BINPERSID
        b"\x80\x05\x96" + (10**12).to_bytes(8, "little") + b".",  # BYTEARRAY8
        b"\x80\x04]\x94h\x00a.",  # a list that holds itself
        b"\x80\x04cnumpy\nndarray\n.",  # a function as value
        b"\x80\x04]" + b"".join(b"\x94(" + b"h" + bytes([i]) + b"h" + bytes([i]) + b"l"
                                for i in range(60)) + b".",  # 2^60 items by reference
    ],
)  # fmt: skip
def test_instructions_out_of_place_are_refused(tmp_path: Path, body: bytes) -> None:
    (tmp_path / "x.pkl").write_bytes(body)
    with pytest.raises(ClipError, match=r"x\.pkl"):
        load_pickle(tmp_path / "x.pkl")


@pytest.mark.parametrize(
    "module, name", [(m, n) for m, names in ALLOWED.items() for n in names]
)  # fmt: skip
def test_any_arguments_give_a_plain_value_or_an_error(
    tmp_path: Path, module: str, name: str
) -> None:
    """200 random calls of each allowed function; memory stays within what the file holds."""
    random = np.random.default_rng(len(module + name))
    numbers = Named("numpy._core.multiarray", "_reconstruct", Named(*DTYPE, "f8"), (0,), b"b")
    pool: list[object] = [
        0, 1, -1, 10**12, 2**70, 1.5, None, True, "latin1", "f8", "O", "V4", ">i2", "", b"", b"abc",
        bytes(64), (), (2,), (10**9, 10**9), (-1,), [1, 2], {"a": 1}, {1, 2}, numbers,
        Named(*DTYPE, "f8"), Named(*DTYPE, "O"), Named("builtins", "range", 10**9),
        Named("builtins", "slice", 1, 10**9), Named("collections", "OrderedDict"),
    ]  # fmt: skip
    plain = (int, float, complex, str, bytes, bytearray, type(None), list, tuple, dict, set,
             frozenset, slice, range, np.ndarray, np.generic, torch.Tensor)  # fmt: skip
    tracemalloc.start()
    try:
        for _ in range(200):
            args = [pool[i] for i in random.integers(0, len(pool), random.integers(0, 6))]
            path = file_of(Named(module, name, *args), tmp_path / "x.pkl")
            try:
                found = load_pickle(path)
            except ClipError:
                continue
            assert isinstance(found, plain) and getattr(found, "dtype", None) is not np.dtype(
                object
            )
        assert tracemalloc.get_traced_memory()[1] < 2**25
    finally:
        tracemalloc.stop()
