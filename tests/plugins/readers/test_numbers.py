"""Numbers of data sets' files: what is none is named, with its file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hoigs.core.errors import ClipError
from hoigs.core.system.unpickling import load_pickled_npy
from hoigs.plugins.readers.checked_files import entry, numbers, read_lines
from hoigs.plugins.readers.points import load_mesh


def test_numbers_of_a_shape():
    assert numbers([[1, 2]], "x", -1, 2).tolist() == [[1, 2]]
    assert numbers([[1], [True]], "x", 2, flat=True).tolist() == [1, 1]
    assert numbers([], "x").size == 0


@pytest.mark.parametrize(
    "value",
    [
        {"a": 1}, "x", [1, "x"], [[1], [1, 2]], [{}], None, 10**400, [1j],
        np.array(["a"]), [[]] * 3 + [1], np.zeros(3), [[1.0, np.nan]], [[np.inf, 0]],
    ],
)  # fmt: skip
def test_what_is_no_such_number_is_named(value):
    with pytest.raises(ClipError, match=r"^a\.json: ") as refused:
        numbers(value, "a.json", 1, 2)
    assert len(str(refused.value)) < 300


def test_keys_that_are_absent():
    assert entry({"a": 1}, "a", "x.pkl") == 1
    for table in ({"b": 1}, [1], None, np.zeros(2)):
        with pytest.raises(ClipError, match=r"^x\.pkl has no 'a'"):
            entry(table, "a", "x.pkl")


def test_lines_of_a_text(tmp_path: Path):
    path = tmp_path / "list.txt"
    path.write_bytes(b" 1\r\n\n2 ")
    assert read_lines(path) == ["1", "2"]
    path.write_bytes(b"1\xa5\n")
    with pytest.raises(ClipError, match=r"list\.txt is not text in UTF-8"):
        read_lines(path)


def test_a_header_that_lies(tmp_path: Path):
    path = tmp_path / "a.npy"
    with path.open("wb") as file:
        header = {"descr": "<f4", "fortran_order": False, "shape": (2**70,)}
        np.lib.format.write_array_header_1_0(file, header)
    with pytest.raises(ClipError, match=r"a\.npy is not a readable"):
        load_pickled_npy(path)


@pytest.mark.parametrize("text", ["v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "v 0 0\nv 1 0\n"])
def test_meshes_that_cannot_be(tmp_path: Path, text: str):
    path = tmp_path / "a.obj"
    path.write_text(text)
    with pytest.raises(ClipError, match=r"a\.obj is not a mesh"):
        load_mesh(path)
