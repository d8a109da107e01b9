"""Running kernels on the cores of this machine."""

from __future__ import annotations

from typing import Any

import torch

from hoigs.core.cpu_kernels.launch import prepared
from hoigs.core.cpu_kernels.workers import SerialWorkers, Workers


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
