"""Running Warp's CPU kernels on several cores.

Warp runs a CPU launch as one loop on the calling thread and releases the GIL meanwhile. Two ways to
use more cores, with the same results bit for bit:

- *openmp*: the launches run on torch's own OpenMP pool, which is awake after torch's operators, so
  nobody spins against anybody. It reaches into private parts of Warp, so it is checked first.
- *threads*: Python threads, with public interfaces only.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal, Protocol

import torch

from hoigs.core.errors import RenderError
from hoigs.rasterizers.warp.calls import flat, record
from hoigs.rasterizers.warp.runtime import wp

Scheduler = Literal["auto", "openmp", "threads", "serial"]


class Workers(Protocol):
    """Something that finishes a list of recorded launches, in any order, before it returns.

    Attributes:
        name: for reports.
        worthwhile: Gaussians that are worth another worker: about what waking it takes.
    """

    name: str
    worthwhile: int

    def run(self, launches: Sequence[Any]) -> None: ...


class SerialWorkers:
    name = "serial"
    worthwhile = 2**31

    def run(self, launches: Sequence[Any]) -> None:
        for launch in launches:
            launch.launch()


class ThreadWorkers:
    """A shared pool of Python threads; the caller is one of the workers."""

    name = "threads"
    worthwhile = 4096
    _pool: ThreadPoolExecutor | None = None
    _owner = 0

    def run(self, launches: Sequence[Any]) -> None:
        others = [self._executor().submit(launch.launch) for launch in launches[1:]]
        launches[0].launch()
        for future in others:
            future.result()

    @classmethod
    def _executor(cls) -> ThreadPoolExecutor:
        if cls._pool is None or cls._owner != os.getpid():  # threads do not survive a fork
            cls._pool = ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="hoigs-warp")
            cls._owner = os.getpid()
        return cls._pool


class _Job(ctypes.Structure):
    _fields_ = (
        ("function", ctypes.c_void_p),
        ("bounds", ctypes.c_void_p),
        ("arguments", ctypes.c_void_p),
    )


class _Queue(ctypes.Structure):
    _fields_ = (("jobs", ctypes.c_void_p), ("count", ctypes.c_int), ("next", ctypes.c_int))


class OpenMPWorkers:
    """torch's libgomp pool, entered through a function that Warp compiles (`cpu_kernels`).

    Raises:
        RuntimeError, OSError, AttributeError: this machine, torch or Warp does not offer it.
    """

    name = "openmp"
    worthwhile = 512

    def __init__(self) -> None:
        from warp._src.context import _build_cpu_args_structs

        from hoigs.rasterizers.warp import cpu_kernels

        self._arguments = _build_cpu_args_structs
        folder = Path(torch.__file__).parent / "lib"
        found = sorted(folder.glob("libgomp*.so*"))
        if not found:
            raise OSError(f"no libgomp in {folder}: torch was built with another OpenMP")
        self._gomp = ctypes.CDLL(str(found[0])).GOMP_parallel
        self._gomp.restype = None
        address = wp.zeros(1, dtype=wp.uint64, device="cpu")
        wp.launch(cpu_kernels.queue_address, dim=1, inputs=[address], device="cpu")
        self._drain = ctypes.c_void_p(int(address.numpy()[0]))
        self._check(cpu_kernels.sum_numbers)

    def run(self, launches: Sequence[Any]) -> None:
        jobs = (_Job * len(launches))()
        keep = []
        for job, launch in zip(jobs, launches):
            arguments, _ = self._arguments(launch.kernel, launch.hooks, launch.params, False)
            bounds = launch.params[0]
            keep.append((launch, arguments, bounds))
            job.function = ctypes.cast(launch.hooks.forward, ctypes.c_void_p).value
            job.bounds = ctypes.addressof(bounds)
            job.arguments = ctypes.addressof(arguments)
        queue = _Queue(ctypes.addressof(jobs), len(launches), 0)
        self._gomp(self._drain, ctypes.byref(queue), ctypes.c_uint(len(launches)), ctypes.c_uint(0))

    def _check(self, kernel: Any) -> None:
        """Run something small and see that all of it was done."""
        sums = [torch.zeros(1, dtype=torch.int32) for _ in range(4)]
        self.run([record(kernel, 10, [flat(s)]) for s in sums])
        if [int(s) for s in sums] != [45] * 4:
            raise RuntimeError(f"a trial on torch's OpenMP pool gave {sums}, expected 45 each")


def make_workers(scheduler: Scheduler) -> tuple[Workers, str]:
    """Workers and a line that says why they were chosen.

    Raises:
        RenderError: "openmp" was asked for and cannot be used here.
    """
    if scheduler == "serial":
        return SerialWorkers(), "asked for"
    if scheduler == "threads":
        return ThreadWorkers(), "asked for"
    try:
        workers = OpenMPWorkers()
    except (ImportError, OSError, AttributeError, RuntimeError, TypeError) as error:
        reason = f"torch's OpenMP pool cannot be used here: {error}"
        if scheduler == "openmp":
            raise RenderError(f'WarpRasterizer: {reason}; use scheduler="threads"') from error
        return ThreadWorkers(), reason
    return workers, "torch's OpenMP pool passed its trial"
