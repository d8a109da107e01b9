import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from hoigs.core.system import npz
from hoigs.core.system.npz import load_arrays


def test_arrays_are_those_of_numpy(tmp_path):
    path = tmp_path / "a.npz"
    arrays = {
        "transposed": np.arange(6).reshape(2, 3).T,
        "scalar": np.float32(3),
        "empty": np.zeros((0, 3)),
        "text": np.array(["x", "yy"]),
    }
    np.savez_compressed(path, **arrays)
    read = load_arrays(path)
    assert list(read) == list(arrays)
    for name, values in arrays.items():
        np.testing.assert_array_equal(read[name], values)
        assert read[name].dtype == values.dtype and read[name].flags.writeable


def test_pickled_objects_are_refused(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, objects=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match="pickled objects"):
        load_arrays(path)


def test_headers_are_read_one_at_a_time(tmp_path, monkeypatch):
    path = tmp_path / "a.npz"
    np.savez(path, **{f"a{i}": np.zeros((i, 2)) for i in range(5)})
    inside, header = [], npz._parsed

    def slow(file):
        inside.append(1)
        assert len(inside) == 1
        time.sleep(1e-4)
        inside.pop()
        return header(file)

    monkeypatch.setattr(npz, "_parsed", slow)
    with ThreadPoolExecutor(8) as pool:
        assert all(len(read) == 5 for read in pool.map(load_arrays, [path] * 40))
