"""joblib's files without joblib: what it writes is read, and code in them is not run."""

from __future__ import annotations

import gzip
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hoigs.core.errors import ClipError
from hoigs.core.system import joblib_file
from hoigs.core.system.joblib_file import load_joblib

joblib = pytest.importorskip("joblib", reason="pip install joblib: it writes what is read here")

CONTENT = {
    1: {
        "pose": [np.arange(72, dtype=np.float32), np.zeros((0, 3))],
        "betas": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "name": "romp", "none": None, "bytes": np.frombuffer(b"ab", np.uint8),
        "scalar": np.float32(3.5),
    }
}  # fmt: skip


def same(a: Any, b: Any) -> bool:
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list):
        return len(a) == len(b) and all(map(same, a, b))
    return type(a) is type(b) and np.array_equal(a, b)


@pytest.mark.parametrize(
    "options", [{}, {"compress": 3}, {"compress": ("gzip", 3)}, {"protocol": 2}, {"protocol": 5}]
)
def test_what_joblib_writes(tmp_path: Path, options: dict[str, Any]) -> None:
    joblib.dump(CONTENT, tmp_path / "x.pkl", **options)
    assert same(load_joblib(tmp_path / "x.pkl"), CONTENT)


def test_a_plain_pickle(tmp_path: Path) -> None:
    (tmp_path / "x.pkl").write_bytes(pickle.dumps(CONTENT))
    assert same(load_joblib(tmp_path / "x.pkl"), CONTENT)


class Evil:
    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (Path("ran"),))


@pytest.mark.parametrize("content", [{"a": Evil()}, {"a": np.array([Evil(), 1], dtype=object)}])
def test_code_is_not_run(tmp_path: Path, monkeypatch: Any, content: Any) -> None:
    monkeypatch.chdir(tmp_path)
    joblib.dump(content, tmp_path / "x.pkl")
    with pytest.raises(ClipError, match=r"x\.pkl cannot be read: it "):
        load_joblib(tmp_path / "x.pkl")
    assert not (tmp_path / "ran").exists()


def test_what_unfolds_without_end_is_refused(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(joblib_file, "SMALL_BYTES", 2**20)
    (tmp_path / "x.pkl").write_bytes(gzip.compress(bytes(2**22)))
    with pytest.raises(ClipError, match="bytes unfold to more than"):
        load_joblib(tmp_path / "x.pkl")


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    joblib.dump(CONTENT, tmp_path / "x.pkl")
    content = (tmp_path / "x.pkl").read_bytes()
    (tmp_path / "x.pkl").write_bytes(content[: len(content) // 2])
    with pytest.raises(ClipError, match=r"x\.pkl cannot be read"):
        load_joblib(tmp_path / "x.pkl")
