"""Pickled dictionaries are read; code in them is not run."""

from __future__ import annotations

import io
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from hoigs.core.errors import ClipError
from hoigs.core.unpickling.pickles import load_pickle, load_pickled_npy

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
