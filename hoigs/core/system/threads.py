"""Settings of this process: how its threads wait for each other, and the memory that it keeps.

While other programs need the processors, threads that wait for each other sleep at once.

By libgomp's documentation a waiting thread spins for GOMP_SPINCOUNT turns, but hardly at all while
the process has more OpenMP threads than there are processors. So a group of threads without work is
kept while this process has to queue for processors. The number of threads that work stays the
same, and with it every result.
"""

from __future__ import annotations

import ctypes
import math
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

# The processors that this process may use.

CGROUP = Path("/sys/fs/cgroup")


def available_cpus() -> int:
    """Processors by affinity and by the quota of the container, at least 1."""
    try:
        count = len(os.sched_getaffinity(0))
    except AttributeError:  # not on macOS and Windows
        count = os.cpu_count() or 1
    quota = _quota(CGROUP)
    return max(1, count if quota is None else min(count, math.ceil(quota)))


def _quota(root: Path) -> float | None:
    """Processors that the control group may use at a time; None without a limit."""
    try:
        limit, period = (root / "cpu.max").read_text().split()
        return None if limit == "max" else int(limit) / int(period)
    except (OSError, ValueError):
        pass
    try:  # version 1 of control groups
        limit_us = int((root / "cpu/cpu.cfs_quota_us").read_text())
        return (
            limit_us / int((root / "cpu/cpu.cfs_period_us").read_text()) if limit_us > 0 else None
        )
    except (OSError, ValueError, ZeroDivisionError):
        return None


# torch's OpenMP library, found without keeping Python's lock.
#
# An extension that is being imported may let go of the GIL and take it again, while its thread
# keeps the loader's lock. ctypes keeps the GIL while it loads a library or looks up a function, and
# waits for the loader's lock: from another thread, both would wait for ever. So the loader is
# called as a C function is, without the GIL.


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


TASKS = Path("/proc/self/task")
SHORT_SPIN = "30000"
"""Turns of libgomp's waiting loop before a thread sleeps; a tenth of libgomp's own default."""
INTERVAL = 1.0  # seconds between two looks
QUEUED = 0.1
"""The machine is busy if threads queue for a processor for this share of their time."""
IDLE = 100_000_000  # nanoseconds in an interval that are too few to tell


def share_processors() -> None:
    """Settings of OpenMP before torch is imported; those that are set already stay.

    Threads sleep while they wait. Where `short_waits_when_busy` can see that the machine is busy,
    libgomp's spin first, since on an idle machine waking them costs more.
    """
    os.environ.setdefault("OMP_NUM_THREADS", str(available_cpus()))
    if {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"} & os.environ.keys():
        return
    os.environ["OMP_WAIT_POLICY"] = "PASSIVE"
    if scheduled() is not None:
        os.environ["GOMP_SPINCOUNT"] = SHORT_SPIN


class Waiting:
    """Decides how threads wait; `look` is called from time to time.

    Attributes:
        short: whether waiting threads sleep at once.
    """

    def __init__(self) -> None:
        self.short = False
        self._before = (0, 0)
        self._release = threading.Event()
        self._holder: threading.Thread | None = None

    def look(self) -> None:
        """Compare the times since the last call, and change how threads wait."""
        now = scheduled() or (0, 0)
        ran, queued = now[0] - self._before[0], now[1] - self._before[1]
        self._before = now
        if min(ran, queued) < 0 or ran + queued < IDLE:  # threads have ended, or hardly any work
            return
        self.set(queued > QUEUED * (ran + queued))

    def set(self, short: bool) -> None:
        if short and not self.short:
            gomp = loaded_gomp()
            if gomp is None:
                return
            self._release = threading.Event()
            self._holder = threading.Thread(
                target=_idle_threads, args=(gomp, self._release), daemon=True
            )
            self._holder.start()
        elif self._holder is not None and not short:
            self._release.set()
            self._holder.join()
            self._holder = None
        self.short = short


_one = threading.Lock()  # held by the block that looks


@contextmanager
def short_waits_when_busy() -> Iterator[None]:
    """In the block, look every second whether this process has to queue for processors.

    Nothing is done within another such block, where a user has set how threads wait, where the
    system does not say how long they queue, or where torch uses another library than libgomp.
    """
    users = {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"} & os.environ.keys()
    ours = not users or os.environ.get("GOMP_SPINCOUNT") == SHORT_SPIN
    if not ours or scheduled() is None or not _one.acquire(blocking=False):
        yield
        return
    waiting, ended = Waiting(), threading.Event()

    def watch() -> None:
        while not ended.wait(INTERVAL):
            waiting.look()
        waiting.set(False)

    c_library()  # before there is a second thread
    watcher = threading.Thread(target=watch, name="hoigs-waits", daemon=True)
    watcher.start()
    try:
        yield
    finally:
        ended.set()
        watcher.join()  # no thread is to run on while the interpreter ends
        _one.release()


def scheduled() -> tuple[int, int] | None:
    """Nanoseconds that the threads of this process ran, and that they queued for a processor.

    None where the system does not say so.
    """
    ran, queued, known = 0, 0, False
    for path in TASKS.glob("*/schedstat"):
        try:
            numbers = path.read_text().split()
            ran, queued, known = ran + int(numbers[0]), queued + int(numbers[1]), True
        except (OSError, ValueError, IndexError):  # a thread that has just ended
            continue
    return (ran, queued) if known else None


def _idle_threads(gomp: Gomp, release: threading.Event) -> None:
    """Keep a thread more than there are processors, all asleep, until `release`.

    libgomp ends them with the thread that runs this.
    """
    nothing = c_library().free  # of NULL; no thread of libgomp is to enter Python
    gomp.parallel(nothing, None, gomp.processors() + 1, 0)
    release.wait()


# Memory that was freed is used again, not given back to the system after every training step.
#
# A step on a CPU allocates and frees some 100 MB of tensors. By default glibc returns what is free
# at the end of its heap, and the system clears each page anew when it is asked for again: a tenth
# of the time of a person's deformation.

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


@contextmanager
def one_thread() -> Iterator[None]:
    """Of torch: with a few thousand numbers at a time, threads wait for each other longer than
    they compute, and a hundred times as long where other programs run."""
    import torch  # on use: the command line sets its threads before it is loaded

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
