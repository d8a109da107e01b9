"""Launching kernels on CUDA with little overhead: launches are cached, only arguments change.

Warp's own `wp.launch` takes some 13 µs and `wp.from_torch` 9 µs for each array; filling in the
arguments of a cached launch takes a quarter of a microsecond each.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from operator import itemgetter
from typing import Any

import torch

from hoigs.core.fast.launch import flat, vector_sizes
from hoigs.core.system.quiet_warp import wp


class _Launch:
    """A launch of Warp's whose arguments are filled in where it reads them."""

    def __init__(self, kernel: Any, block: int, arguments: Sequence[Any], stream: Any) -> None:
        sizes = vector_sizes(kernel, arguments)
        inputs = [
            flat(torch.empty(0, dtype=value.dtype), size) if size else value
            for size, value in zip(sizes, arguments)
        ]
        self._launch = wp.launch(
            kernel,
            dim=block,
            inputs=inputs,
            device=stream.device,
            stream=stream,
            block_dim=block,
            record_cmd=True,
        )
        self._launch.fwd_args = None  # kept only to relocate arrays in graphs of Warp's own
        parameters = self._launch.params[1:]
        arrays = [i for i, size in enumerate(sizes) if size]
        numbers = [i for i, size in enumerate(sizes) if not size]
        self._arrays = [parameters[i] for i in arrays]
        self._numbers = [parameters[i] for i in numbers]
        self._tensors_of, self._numbers_of = _picker(arrays), _picker(numbers)
        self._filled: Any = None  # numbers, which are the same in most launches

    def run(self, threads: int, arguments: Sequence[Any], stream: Any) -> None:
        for array, tensor in zip(self._arrays, self._tensors_of(arguments)):
            array.data = tensor.data_ptr()
        numbers = self._numbers_of(arguments)
        if numbers != self._filled:
            for parameter, number in zip(self._numbers, numbers):
                parameter.value = number
            self._filled = numbers
        if self._launch.bounds.size != threads:
            self._launch.set_dim(threads)
        self._launch.launch(stream)


def _picker(indices: list[int]) -> Callable[[Sequence[Any]], Sequence[Any]]:
    """Takes the values at these indices, of which `itemgetter` would not make a tuple if one."""
    if len(indices) > 1:
        return itemgetter(*indices)
    return lambda values: tuple(values[i] for i in indices)


class CudaStream:
    """Launches kernels on one stream of torch's."""

    def __init__(self, stream: Any, launches: dict[Any, _Launch], lock: threading.Lock) -> None:
        self._stream, self._launches, self._lock = wp.stream_from_torch(stream), launches, lock

    def each(self, kernel: Any, count: int, arguments: list[Any], block: int = 128) -> None:
        """Run a kernel for items 0 to count; its last two parameters, base and count, are added."""
        self.blocks(kernel, -(-count // block), block, [*arguments, 0, count])

    def blocks(self, kernel: Any, blocks: int, block: int, arguments: Sequence[Any]) -> None:
        """Run a kernel on whole blocks of threads.

        Args:
            kernel: its array parameters are flat.
            blocks: how many. block: threads of each.
            arguments: numbers, and contiguous tensors for arrays.
        """
        if blocks == 0:
            return
        with self._lock:
            launch = self._launches.get(kernel)
            if launch is None:
                launch = self._launches[kernel] = _Launch(kernel, block, arguments, self._stream)
            launch.run(blocks * block, arguments, self._stream)


class CudaStreams:
    """Finds torch's current stream at each call, by its address: torch's object for it would take
    ten times as long."""

    def __init__(self) -> None:
        self._streams: dict[tuple[int, int], CudaStream] = {}
        self._launches: dict[int, dict[Any, _Launch]] = {}
        # arguments are filled in where Warp's launch reads them, and autograd has a thread of its
        # own for CUDA
        self._lock = threading.Lock()

    def current(self, device: int | None = None) -> CudaStream:
        index = torch.cuda.current_device() if device is None else device
        key = (index, torch._C._cuda_getCurrentRawStream(index))
        found = self._streams.get(key)
        if found is None:
            launches = self._launches.setdefault(index, {})
            stream = torch.cuda.current_stream(index)
            found = self._streams[key] = CudaStream(stream, launches, self._lock)
        return found
