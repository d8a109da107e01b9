"""release_pages: memory of tensors whose numbers also lie in a file goes back to the system."""

from __future__ import annotations

import ctypes
import mmap
import sys
from collections.abc import Iterable

from torch import Tensor

from hoigs.core.machine.gomp import c_library

PAGEOUT = 21  # Linux's MADV_PAGEOUT: pages are read anew when they are used, nothing is lost


def release_pages(tensors: Iterable[Tensor]) -> None:
    """Let the system take back what was read of tensors that are mapped from a file.

    Their values stay as they are. Tensors that are not mapped from a file keep their memory where
    the machine has no swap. Systems without this advice (Linux has it since 5.4) do nothing.
    """
    if sys.platform != "linux":
        return
    for tensor in tensors:
        if tensor.device.type != "cpu" or not tensor.is_contiguous() or not tensor.nbytes:
            continue
        first = tensor.data_ptr() // mmap.PAGESIZE * mmap.PAGESIZE
        size = tensor.data_ptr() + tensor.nbytes - first
        c_library().madvise(ctypes.c_void_p(first), ctypes.c_size_t(size), PAGEOUT)
