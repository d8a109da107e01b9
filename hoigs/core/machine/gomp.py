"""torch's OpenMP library, found without keeping Python's lock.

An extension that is being imported may let go of the GIL and take it again, while its thread keeps
the loader's lock. ctypes keeps the GIL while it loads a library or looks up a function, and waits
for the loader's lock: from another thread, both would wait for ever. So the loader is called as a C
function is, without the GIL.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Gomp:
    """Functions of libgomp.

    Attributes:
        parallel: `GOMP_parallel(function, its argument, threads, flags)`.
        processors: `omp_get_num_procs()`.
    """

    parallel: Callable[..., Any]
    processors: Callable[[], int]


@cache
def c_library() -> Any:
    """The C library. First called before there are other threads."""
    library = ctypes.CDLL(None)
    library.dlopen.argtypes = (ctypes.c_char_p, ctypes.c_int)
    library.dlsym.argtypes = (ctypes.c_void_p, ctypes.c_char_p)
    library.dlopen.restype = library.dlsym.restype = ctypes.c_void_p
    library.free  # noqa: B018 - ctypes looks it up here and keeps it
    return library


def loaded_gomp() -> Gomp | None:
    """The libgomp that torch brought and has loaded; None without one."""
    torch = sys.modules.get("torch")
    if torch is None or not hasattr(os, "RTLD_NOLOAD"):
        return None
    found = c_library()
    for path in sorted((Path(str(torch.__file__)).parent / "lib").glob("libgomp*.so*")):
        handle = found.dlopen(os.fsencode(path), os.RTLD_NOLOAD | os.RTLD_NOW)
        if not handle:  # torch is just being imported
            continue
        parallel = found.dlsym(handle, b"GOMP_parallel")
        processors = found.dlsym(handle, b"omp_get_num_procs")
        if parallel and processors:
            pointer = ctypes.c_void_p
            return Gomp(
                ctypes.CFUNCTYPE(None, pointer, pointer, ctypes.c_uint, ctypes.c_uint)(parallel),
                ctypes.CFUNCTYPE(ctypes.c_int)(processors),
            )
    return None
