"""release_pages: memory of tensors whose numbers also lie in a file goes back to the system."""

from __future__ import annotations

import ctypes
import mmap
import sys
from collections.abc import Iterable

from torch import Tensor, nn

from hoigs.core.machine.gomp import c_library
from hoigs.core.time_rows import timed_parameters

PAGEOUT = 21  # Linux's MADV_PAGEOUT: pages are read anew when they are used, nothing is lost
PIECE = 256  # frames after which what was read for them is given back


def release_time_rows(model: nn.Module) -> None:
    """Give back the memory of rows for times that `restore_model` left in a file."""
    release_pages(model.get_parameter(name) for name, _ in timed_parameters(model))


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
