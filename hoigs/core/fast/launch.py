"""Launching Warp's kernels on a CPU with little overhead: a training step makes dozens of launches.

`wp.from_torch` and `wp.launch` take some microseconds for each argument. Here descriptors and
launches are copied from a template that they made once, and only what differs is filled in.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol

import torch
from torch import Tensor

from hoigs.core.system.quiet_warp import wp

# Warp and its flags; the other modules take `wp` from here.


# -ffp-contract=fast: multiply-adds in one instruction, which is not Warp's default on CPUs
CPU_FLAGS = f"{wp.config.cpu_compiler_flags or '-march=native'} -ffp-contract=fast"
_TYPES = {
    torch.float32: wp.float32,
    torch.float64: wp.float64,
    torch.int32: wp.int32,
    torch.int64: wp.int64,
    torch.uint8: wp.uint8,
}
_descriptors: dict[tuple[torch.dtype, int], tuple[type, bytes]] = {}
_launches: dict[Any, tuple[Any, Any, list[tuple[Any, Any, int]]]] = {}


def flat(tensor: Tensor, size: int = 1) -> Any:
    """A contiguous tensor as a flat array of numbers, or of vectors of `size` floats.

    The descriptor keeps the tensor alive.
    """
    return _described(tensor, *_template(tensor.dtype, size), size)


def _template(dtype: torch.dtype, size: int) -> tuple[type, bytes]:
    """Type and bytes of a descriptor, as Warp makes it."""
    if (dtype, size) not in _descriptors:
        one = torch.zeros((1, size) if size > 1 else 1, dtype=dtype)
        element = wp.types.vector(size, wp.float32) if size > 1 else _TYPES[dtype]
        array = wp.from_torch(one, dtype=element, requires_grad=False, return_ctype=True)
        _descriptors[dtype, size] = type(array), bytes(array)
    return _descriptors[dtype, size]


def _described(tensor: Tensor, kind: Any, template: bytes, size: int) -> Any:
    array = kind.from_buffer_copy(template)
    array.data = tensor.data_ptr()
    array.shape[0] = tensor.numel() // size
    array._ref = tensor
    return array


def vector_sizes(kernel: Any, arguments: Sequence[Any]) -> list[int]:
    """Floats of one element of each array parameter of a kernel, 0 where it is a number.

    Raises:
        TypeError: the kernel has another number of parameters.
    """
    kinds = [parameter.type for parameter in kernel.adj.args]
    if len(kinds) != len(arguments):
        raise TypeError(f"{kernel.key} takes {len(kinds)} arguments, got {len(arguments)}")
    return [
        getattr(kind.dtype, "_length_", 1) if isinstance(value, Tensor) else 0
        for kind, value in zip(kinds, arguments)
    ]


def prepared(kernel: Any, dim: int, arguments: Sequence[Any]) -> Any:
    """A launch on the CPU, to be run by its `launch()`, also on several threads at once.

    Args:
        kernel: its array parameters are flat.
        dim: number of threads in Warp's sense.
        arguments: numbers, and contiguous tensors for arrays.
    """
    known = _launches.get(kernel)
    if known is None:
        sizes = vector_sizes(kernel, arguments)
        inputs = [flat(x, size) if size else x for size, x in zip(sizes, arguments)]
        prototype = wp.launch(kernel, dim=1, inputs=inputs, device="cpu", record_cmd=True)
        prototype.fwd_args = None
        bounds, *parameters = prototype.params
        kinds = [
            (*_template(x.dtype, size), size) if size else (type(p), None, 0)
            for p, x, size in zip(parameters, arguments, sizes)
        ]
        # the descriptors hold these tensors, and with them the autograd graph they belong to
        prototype.params = [bounds]
        known = _launches[kernel] = (prototype, bounds, kinds)
    prototype, bounds, kinds = known
    if len(kinds) != len(arguments):
        raise TypeError(f"{kernel.key} takes {len(kinds)} arguments, got {len(arguments)}")
    launch = copy.copy(prototype)
    launch.params = [bounds]
    launch.params += [
        _described(x, kind, template, size) if size else kind(x)
        for (kind, template, size), x in zip(kinds, arguments)
    ]
    if dim != 1:
        launch.set_dim(dim)
    return launch


# Running prepared launches of Warp's CPU kernels on several cores, with public interfaces only.
#
# Warp runs a CPU launch as one loop on the calling thread and releases the GIL meanwhile.


class Workers(Protocol):
    """Runs a list of prepared launches, in any order; all are finished when `run` returns.

    Attributes:
        name: for reports.
        worthwhile: so many Gaussians take about as long as waking another worker.
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
        try:
            self._run(launches)
        except KeyboardInterrupt:
            # A stop within the start of a thread leaves one that its pool does not know, and
            # Python would wait for it at its end. A pool that is shut down wakes it.
            self._executor().shutdown(wait=False)
            type(self)._pool = None
            raise

    def _run(self, launches: Sequence[Any]) -> None:
        others = [(self._executor().submit(task), task) for task in map(_Task, launches[1:])]
        launches[0].launch()
        for future, task in reversed(others):
            if future.cancel():  # its worker has not begun, as on a busy machine
                task()
            else:
                future.result()

    @classmethod
    def _executor(cls) -> ThreadPoolExecutor:
        if cls._pool is None or cls._owner != os.getpid():  # threads do not survive a fork
            cls._pool = ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="hoigs-warp")
            cls._owner = os.getpid()
        return cls._pool


class _Task:
    """A launch that is let go when it is done.

    A pool's thread drops what it ran, or would have run, when it gets a processor again. Arrays
    that live on until then may keep the graph of a step, and with it the shapes that parameters had
    in that step, beyond the moment at which they change.
    """

    def __init__(self, launch: Any) -> None:
        self._launch = launch

    def __call__(self) -> None:
        launch, self._launch = self._launch, None
        launch.launch()


def shared(kernel: Any, items: int, arguments: Sequence[Any]) -> None:
    """One kernel on as many cores as are worth their waking, which share its work items.

    Args:
        kernel: its first parameter is the next item, which every core takes atomically.
        items: in how many parts the work is cut; what they write must not depend on who writes it.
        arguments: after the first.
    """
    cores = max(1, min(torch.get_num_threads(), items))
    launches = [prepared(kernel, 1, [torch.zeros(1, dtype=torch.int32), *arguments])] * cores
    (SerialWorkers() if cores == 1 else ThreadWorkers()).run(launches)
