"""Pickled dictionaries are read; code in them is not run."""

from __future__ import annotations

import io
import pickle
from collections import OrderedDict, defaultdict
from pathlib import Path

import numpy as np
import pytest
import torch

from hoigs.core.errors import ClipError
from hoigs.core.system.unpickling import load_pickle, load_pickled_npy

VALUE = {
    "a": {"K": np.eye(3), "s": np.float32(2.5), "name": "x", "ids": [1, 2], "raw": b"\x00\xff"},
    "b": np.arange(6).reshape(2, 3)[:, ::-1],
    "c": {
        "empty": np.zeros((0, 3)),
        "F": np.eye(2, 3).T,
        "text": np.array(["a", "bcd"]),
        "K": np.arange(24).reshape(2, 3, 4).swapaxes(0, 1),
        "big": np.arange(300, dtype=">i4"),
        "object": np.array([{"a": 1}, None]),
        "none": b"",
        "set": {1, "a"},
        "complex": 2 + 1j,
        "long": 2**63,
        "default": defaultdict(dict, {np.int64(1): OrderedDict(a=(1, [True]))}),
    },
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
    for name, value in VALUE["c"].items():
        np.testing.assert_array_equal(back["c"][name], value)
    with pytest.raises(KeyError):
        back["c"]["default"]["absent"]


@pytest.mark.parametrize("core", [b"numpy.core.", b"numpy._core."])
def test_numpy_1_and_2_are_read(tmp_path: Path, core: bytes) -> None:
    for protocol in (2, 5):
        content = pickle.dumps(np.eye(3), protocol=protocol)
        names = content.replace(b"numpy._core.", b"numpy.core.").replace(b"numpy.core.", core)
        assert names.count(core) == 1
        if protocol == 5:  # whose names have their lengths before them
            at = names.index(core)
            names = names[: at - 1] + bytes([len(core) + len("numeric")]) + names[at:]
        (tmp_path / "x.pkl").write_bytes(names)
        np.testing.assert_array_equal(load_pickle(tmp_path / "x.pkl"), np.eye(3))


def test_npy_with_a_dictionary_and_with_numbers(tmp_path: Path) -> None:
    np.save(tmp_path / "d.npy", VALUE, allow_pickle=True)
    assert load_pickled_npy(tmp_path / "d.npy")["a"]["name"] == "x"
    np.save(tmp_path / "n.npy", np.arange(3))
    np.testing.assert_array_equal(load_pickled_npy(tmp_path / "n.npy"), np.arange(3))
    np.save(tmp_path / "o.npy", np.array([{"a": 1}, {"a": 2}], dtype=object), allow_pickle=True)
    assert load_pickled_npy(tmp_path / "o.npy")[1] == {"a": 2}


def test_npy_whose_pickle_is_not_the_array_of_its_header(tmp_path: Path) -> None:
    np.save(tmp_path / "x.npy", VALUE, allow_pickle=True)
    header = (tmp_path / "x.npy").read_bytes()[:128]
    (tmp_path / "x.npy").write_bytes(header + pickle.dumps([1]))
    with pytest.raises(ClipError, match=r"x\.npy holds a list.*\(\)"):
        load_pickled_npy(tmp_path / "x.npy")


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
