"""Running prepared launches of Warp's CPU kernels on several cores, with public interfaces only.

Warp runs a CPU launch as one loop on the calling thread and releases the GIL meanwhile.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol

import torch

from hoigs.core.cpu_kernels.launch import prepared


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
