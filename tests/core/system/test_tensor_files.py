"""Tensors in files: read and written by rows, and put into a safetensors file unread."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors.torch import load_file

from hoigs.core.system.tensor_files import TensorFile, save_tensors


def test_rows_are_written_and_read(tmp_path: Path) -> None:
    file = TensorFile(tmp_path / "a", (2, 5, 3))
    file.zero()
    assert not file.read().any()
    whole = torch.rand(2, 5, 3)
    file.write(whole)
    assert torch.equal(file.read(slice(1, 4)), whole[:, 1:4])
    file.write(torch.ones(2, 2, 3), slice(3, 5))
    assert torch.equal(file.read()[:, :3], whole[:, :3])
    assert (file.read()[:, 3:] == 1).all()


def test_a_safetensors_file_is_read_back(tmp_path: Path) -> None:
    file = TensorFile(tmp_path / "a", (2, 3))
    file.write(torch.arange(6.0).reshape(2, 3))
    tensors = {
        "bytes": torch.tensor([1, 2, 3], dtype=torch.uint8), "double": torch.rand(2).double(),
        "empty": torch.zeros(0, 3), "flags": torch.tensor([True, False]),
        "number": torch.tensor(4.0), "turned": torch.rand(3, 2).T, "wide": torch.tensor([2**40]),
    }  # fmt: skip
    save_tensors({**tensors, "filed": file}, tmp_path / "all.safetensors")
    read = load_file(tmp_path / "all.safetensors")
    assert set(read) == {*tensors, "filed"}
    for name, tensor in tensors.items():
        assert torch.equal(read[name], tensor)
        assert read[name].dtype == tensor.dtype
    assert read["filed"].tolist() == [[0, 1, 2], [3, 4, 5]]
