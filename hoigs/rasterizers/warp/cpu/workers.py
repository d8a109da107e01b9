"""Running Warp's CPU kernels on several cores.

Warp runs a CPU launch as one loop on the calling thread and releases the GIL meanwhile. Two ways to
use more cores, with the same results bit for bit:

- *openmp*: the launches run on torch's own OpenMP pool, so that no second pool competes with it for
  cores. This uses private parts of Warp, so a trial run checks it first.
- *threads*: Python threads, with public interfaces only.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any, Literal

import torch

from hoigs.core.cpu_kernels.launch import prepared
from hoigs.core.cpu_kernels.runtime import wp
from hoigs.core.cpu_kernels.workers import SerialWorkers, ThreadWorkers, Workers
from hoigs.core.errors import RenderError
from hoigs.core.machine.gomp import loaded_gomp

Scheduler = Literal["auto", "openmp", "threads", "serial"]


class _Job(ctypes.Structure):
    _fields_ = (
        ("function", ctypes.c_void_p),
        ("bounds", ctypes.c_void_p),
        ("arguments", ctypes.c_void_p),
    )


class _Queue(ctypes.Structure):
    _fields_ = (("jobs", ctypes.c_void_p), ("count", ctypes.c_int), ("next", ctypes.c_int))


class OpenMPWorkers:
    """torch's libgomp pool, called through a function that Warp compiles (`native_kernels`).

    Raises:
        RuntimeError, OSError, AttributeError: this machine, torch or Warp does not offer it.
    """

    name = "openmp"
    worthwhile = 512

    def __init__(self) -> None:
        from warp._src.context import _build_cpu_args_structs

        from hoigs.rasterizers.warp.cpu import native_kernels

        self._arguments = _build_cpu_args_structs
        gomp = loaded_gomp()
        if gomp is None:
            raise OSError(f"no libgomp beside {torch.__file__}: it was built with another OpenMP")
        self._gomp = gomp.parallel
        address = wp.zeros(1, dtype=wp.uint64, device="cpu")
        wp.launch(native_kernels.queue_address, dim=1, inputs=[address], device="cpu")
        self._drain = ctypes.c_void_p(int(address.numpy()[0]))
        self._check(native_kernels.sum_numbers)

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
        self._gomp(self._drain, ctypes.byref(queue), len(launches), 0)

    def _check(self, kernel: Any) -> None:
        """Run a small kernel and compare its results."""
        sums = [torch.zeros(1, dtype=torch.int32) for _ in range(4)]
        self.run([prepared(kernel, 10, [s]) for s in sums])
        if [int(s) for s in sums] != [45] * 4:
            raise RuntimeError(f"a trial on torch's OpenMP pool gave {sums}, expected 45 each")


def make_workers(scheduler: Scheduler) -> tuple[Workers, str]:
    """Workers and a line with the reason for the choice.

    Raises:
        RenderError: "openmp" is requested and cannot be used here.
    """
    if scheduler == "serial":
        return SerialWorkers(), "requested"
    if scheduler == "threads":
        return ThreadWorkers(), "requested"
    try:
        workers = OpenMPWorkers()
    except (ImportError, OSError, AttributeError, RuntimeError, TypeError) as error:
        reason = f"torch's OpenMP pool cannot be used here: {error}"
        if scheduler == "openmp":
            raise RenderError(f'WarpRasterizer: {reason}; use scheduler="threads"') from error
        return ThreadWorkers(), reason
    return workers, "torch's OpenMP pool passed its trial"
