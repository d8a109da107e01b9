"""Launching kernels on CUDA with little overhead: launches are cached, only arguments change.

Warp's own `wp.launch` takes some 13 µs and `wp.from_torch` 9 µs for each array; filling in the
arguments of a cached launch takes a quarter of a microsecond each.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any

import torch

from hoigs.core.fast.launch import flat, vector_sizes
from hoigs.core.system.quiet_warp import wp


class CudaStream:
    """Launches kernels on one stream of torch's."""

    def __init__(self, stream: Any, launches: dict[Any, Any], lock: threading.Lock) -> None:
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
            known = self._launches.get(kernel)
            if known is None:
                known = self._launches[kernel] = _prepared(kernel, block, arguments, self._stream)
            launch, parameters = known
            for (parameter, is_array), value in zip(parameters, arguments):
                if is_array:
                    parameter.data = value.data_ptr()
                else:
                    parameter.value = value
            if launch.bounds.size != blocks * block:
                launch.set_dim(blocks * block)
            launch.launch(self._stream)


class CudaStreams:
    """Finds torch's current stream at each call.

    Given the number of the device, torch finds it in half the time.
    """

    def __init__(self) -> None:
        self._streams: dict[tuple[int, int], CudaStream] = {}
        self._launches: dict[int, dict[Any, Any]] = {}
        # arguments are filled in where Warp's launch reads them, and autograd has a thread of its
        # own for CUDA
        self._lock = threading.Lock()

    def current(self, device: int | None = None) -> CudaStream:
        stream = torch.cuda.current_stream(device)
        key = (stream.device_index, stream.cuda_stream)
        found = self._streams.get(key)
        if found is None:
            launches = self._launches.setdefault(key[0], {})
            found = self._streams[key] = CudaStream(stream, launches, self._lock)
        return found


def _prepared(
    kernel: Any, block: int, arguments: Sequence[Any], stream: Any
) -> tuple[Any, list[Any]]:
    """A launch, and its parameters to be filled in, each with whether it is an array."""
    sizes = vector_sizes(kernel, arguments)
    inputs = [
        flat(torch.empty(0, dtype=value.dtype), size) if size else value
        for size, value in zip(sizes, arguments)
    ]
    launch = wp.launch(
        kernel,
        dim=block,
        inputs=inputs,
        device=stream.device,
        stream=stream,
        block_dim=block,
        record_cmd=True,
    )
    launch.fwd_args = None  # kept only to relocate arrays in graphs of Warp's own
    return launch, [(p, size > 0) for p, size in zip(launch.params[1:], sizes)]
