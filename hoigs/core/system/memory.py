"""Memory that was freed is used again, not given back to the system after every training step.

A step on a CPU allocates and frees some 100 MB of tensors. By default glibc returns what is free at
the end of its heap, and the system clears each page anew when it is asked for again: a tenth of the
time of a person's deformation.
"""

from __future__ import annotations

import ctypes
import sys

# numbers of mallopt's parameters (malloc.h)
M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD = -1, -2, -3
LARGEST_IN_HEAP = 32 << 20  # bytes; the most that glibc takes
KEPT = 256 << 20  # free bytes at the end of the heap
STEP = 16 << 20  # bytes by which the heap grows


def keep_freed_memory() -> bool:
    """Settings of glibc's allocator for this process; False where it is another one."""
    if sys.platform != "linux":
        return False
    library = ctypes.CDLL(None)
    if not hasattr(library, "gnu_get_libc_version"):
        return False
    wanted = {M_MMAP_THRESHOLD: LARGEST_IN_HEAP, M_TRIM_THRESHOLD: KEPT, M_TOP_PAD: STEP}
    return all(library.mallopt(parameter, value) == 1 for parameter, value in wanted.items())
