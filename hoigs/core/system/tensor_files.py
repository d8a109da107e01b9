"""Tensors in files of their own, and safetensors files written from them piece by piece."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class TensorFile:
    """A float32 tensor whose numbers are the content of a file, in C order."""

    path: Path
    shape: tuple[int, ...]

    def write(self, values: Tensor, rows: slice | None = None) -> None:
        """All of it, or rows along axis 1 of a file that is there."""
        numbers = values.detach().cpu().numpy()
        if rows is None:
            numbers.tofile(self.path)
        else:
            self._mapped("r+")[:, rows] = numbers

    def read(self, rows: slice | None = None) -> Tensor:
        """All of it, or rows along axis 1."""
        if rows is None:
            return torch.from_numpy(np.fromfile(self.path, np.float32).reshape(self.shape))
        return torch.from_numpy(np.array(self._mapped("r")[:, rows]))

    def zero(self) -> None:
        """Make a file of zeros, which takes no place on most disks until it is written."""
        with self.path.open("wb") as file:
            file.truncate(4 * int(np.prod(self.shape, dtype=np.int64)))

    def _mapped(self, mode: str) -> np.memmap:
        return np.memmap(self.path, np.float32, mode, shape=self.shape)  # type: ignore[call-overload]


def save_tensors(tensors: Mapping[str, Tensor | TensorFile], path: Path) -> None:
    """Write a safetensors file, one tensor after another, so that none in a file is in memory.

    Raises:
        OSError: it cannot be written.
    """
    held = {
        n: t if isinstance(t, TensorFile) else t.detach().cpu().contiguous()
        for n, t in tensors.items()
    }
    order = sorted(held, key=lambda n: (-_item_size(held[n]), n))  # aligned, as the format wants
    header: dict[str, object] = {}
    at = 0
    for name in order:
        tensor = held[name]
        size = _item_size(tensor) * int(np.prod(tensor.shape, dtype=np.int64))
        header[name] = {
            "dtype": _KINDS[_dtype(tensor)],
            "shape": list(tensor.shape),
            "data_offsets": [at, at + size],
        }
        at += size
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    with path.open("wb") as file:
        file.write(len(text).to_bytes(8, "little") + text)
        for name in order:
            tensor = held[name]
            if isinstance(tensor, TensorFile):
                with tensor.path.open("rb") as source:
                    shutil.copyfileobj(source, file, 2**20)
            else:
                file.write(tensor.reshape(-1).view(torch.uint8).numpy().data)


_KINDS = {
    torch.float64: "F64", torch.float32: "F32", torch.float16: "F16", torch.bfloat16: "BF16",
    torch.int64: "I64", torch.int32: "I32", torch.int16: "I16", torch.int8: "I8",
    torch.uint8: "U8", torch.bool: "BOOL",
}  # fmt: skip


def _dtype(tensor: Tensor | TensorFile) -> torch.dtype:
    return torch.float32 if isinstance(tensor, TensorFile) else tensor.dtype


def _item_size(tensor: Tensor | TensorFile) -> int:
    return torch.empty(0, dtype=_dtype(tensor)).element_size()
