"""Running Warp's CPU kernels on several cores.

Warp runs a CPU launch as one loop on the calling thread and releases the GIL meanwhile. Two ways to
use more cores, with the same results bit for bit:

- *openmp*: the launches run on torch's own OpenMP pool, so that no second pool competes with it for
  cores. This uses private parts of Warp, so a trial run checks it first.
- *threads*: Python threads, with public interfaces only.
"""

from __future__ import annotations

import ctypes
import warnings
from collections.abc import Sequence
from typing import Any, Literal

import torch

from hoigs.core.errors import RenderError
from hoigs.core.fast.launch import SerialWorkers, ThreadWorkers, Workers, prepared
from hoigs.core.system.quiet_warp import wp
from hoigs.core.system.threads import loaded_gomp

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


# Running kernels on the cores of this machine.


class Cores:
    """CPU cores.

    Args:
        workers: how launches are spread over cores.
        threads: how many cores; with None torch.get_num_threads() at each call.
    """

    def __init__(self, workers: Workers, threads: int | None) -> None:
        self.workers, self.threads = workers, threads

    def number(self, items: int) -> int:
        """How many cores to use for so many work items."""
        return max(1, min(self.threads or torch.get_num_threads(), items))

    def chunks(self, count: int) -> int:
        """In how many parts to process `count` Gaussians."""
        return self.number(count // self.workers.worthwhile)

    def once(self, kernel: Any, arguments: list[Any]) -> None:
        """Run a kernel on the calling thread."""
        prepared(kernel, 1, arguments).launch()

    def together(self, kernel: Any, cores: int, arguments: list[Any]) -> None:
        """Run the same launch on several cores, which share the work through `counters`."""
        self._run([prepared(kernel, 1, arguments)] * cores)

    def each(self, kernel: Any, count: int, arguments: list[Any]) -> None:
        """Run a kernel for items 0 to count; its last two parameters, base and count, are added."""
        if count == 0:
            return
        chunks = self.chunks(count)
        size = -(-count // chunks)
        self._run([prepared(kernel, size, [*arguments, j * size, count]) for j in range(chunks)])

    def _run(self, launches: list[Any]) -> None:
        (SerialWorkers() if len(launches) == 1 else self.workers).run(launches)


# Which CPU kernels this machine can run, found by compiling them.

Kernels = Literal["auto", "native", "portable"]


def choose_kernels(requested: Kernels) -> tuple[Literal["native", "portable"], str]:
    """The kernels to use and a line with the reason.

    "auto" takes the native ones where they compile, else the portable ones with a warning.

    Raises:
        RenderError: "native" is requested and does not compile here.
    """
    if requested == "portable":
        return "portable", "requested"
    try:
        lanes = vector_lanes()
    except Exception as error:  # Warp raises nothing narrower when a build fails
        reason = f"the native kernels do not compile here: {error}"
        if requested == "native":
            raise RenderError(
                f'WarpRasterizer: {reason}; use cpu_kernels="portable" (about ten times slower)'
            ) from error
        warnings.warn(f"WarpRasterizer: {reason}; the portable ones are slower", stacklevel=2)
        return "portable", reason
    return "native", f"they compile, with vectors of {lanes} floats"


def vector_lanes() -> int:
    """Floats in a vector of the native kernels: 16 with AVX-512, else 8. Compiles them."""
    from hoigs.core.fast.launch import prepared
    from hoigs.rasterizers.warp.cpu import native_kernels

    lanes = torch.zeros(1, dtype=torch.int32)
    prepared(native_kernels.count_lanes, 1, [lanes]).launch()
    return int(lanes)
