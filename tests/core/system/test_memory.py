"""Freed memory is used again without page faults."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

CODE = """
import resource, sys
import numpy as np
from hoigs.core.system.threads import keep_freed_memory

def pages() -> int:
    for _ in range(20):
        arrays = [np.ones(2**20) for _ in range(8)]  # 8 MB each
        del arrays
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

if sys.argv[1] == "keep":
    assert keep_freed_memory()
warm = pages()
print(pages() - warm)
"""


def faults(how: str) -> int:
    command = [sys.executable, "-c", CODE, how]
    return int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another allocator")
def test_freed_memory_is_kept() -> None:
    assert faults("keep") < 500
    assert faults("default") > 5000
