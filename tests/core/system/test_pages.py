"""release_pages: what was read of a mapped file leaves memory, and its values stay."""

from __future__ import annotations

import platform
import sys
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from hoigs.core.parameters import release_pages

SIZE = 32 << 20  # bytes


def mapped_kib() -> int:
    """KiB of files that are in this process's memory."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("RssFile"))


LINUX = tuple(map(int, platform.release().split(".")[:2])) if sys.platform == "linux" else (0, 0)


@pytest.mark.skipif(LINUX < (5, 4), reason="Linux takes the advice since 5.4")
def test_pages_of_a_file_leave_memory_and_come_back(tmp_path: Path) -> None:
    values = torch.arange(SIZE // 4, dtype=torch.float32)
    save_file({"a": values}, tmp_path / "a.safetensors")
    with safe_open(tmp_path / "a.safetensors", framework="pt") as file:
        mapped = file.get_tensor("a")
    assert torch.equal(mapped, values)
    before = mapped_kib()
    release_pages([mapped, values, torch.empty(0)])
    assert before - mapped_kib() > 0.9 * SIZE / 1024
    own = torch.arange(SIZE // 4, dtype=torch.float32)
    assert torch.equal(mapped, own) and torch.equal(values, own)
