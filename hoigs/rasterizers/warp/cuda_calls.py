"""Launching kernels on CUDA: a launch is recorded once and then only its arguments change."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from hoigs.rasterizers.warp.calls import flat
from hoigs.rasterizers.warp.runtime import wp


class CudaStream:
    """Launches on torch's current stream of the current device, whichever that is at each call.

    Warp's own `wp.launch` takes some 13 µs and `wp.from_torch` 9 µs for each array; filling in a
    recorded launch takes a fifth of a microsecond for each argument, and 3 µs to launch it.
    """

    def __init__(self) -> None:
        self._streams: dict[tuple[int, int], Any] = {}
        self._launches: dict[tuple[int, Any], Any] = {}
        # arguments are filled in where Warp's launch reads them, and CUDA's autograd has a thread
        # of its own
        self._lock = threading.Lock()

    def each(self, kernel: Any, count: int, arguments: list[Any], block: int = 128) -> None:
        """Run a kernel for items 0 to count; its last two parameters, base and count, are added."""
        self.blocks(kernel, -(-count // block), block, [*arguments, 0, count])

    def blocks(self, kernel: Any, blocks: int, block: int, arguments: Sequence[Any]) -> None:
        """Run a kernel on whole blocks of threads.

        Args:
            kernel: whose array parameters are flat; see `calls.flat`.
            blocks: how many. block: threads of each.
            arguments: numbers, and contiguous tensors for arrays.
        """
        if blocks == 0:
            return
        current = torch.cuda.current_stream()
        key = (current.device_index, current.cuda_stream)
        stream = self._streams.get(key)
        if stream is None:
            stream = self._streams[key] = wp.stream_from_torch(current)
        with self._lock:
            launch = self._launches.get((key[0], kernel))
            if launch is None:
                launch = self._launches[key[0], kernel] = _record(kernel, block, arguments, stream)
            slots = launch.params
            for index, value in enumerate(arguments, 1):
                if isinstance(value, Tensor):
                    slots[index].data = value.data_ptr()
                else:
                    slots[index].value = value
            if launch.bounds.size != blocks * block:
                launch.set_dim(blocks * block)
            launch.launch(stream)


def _record(kernel: Any, block: int, arguments: Sequence[Any], stream: Any) -> Any:
    """A launch whose arguments are placeholders of the right types."""
    kinds = [a.type for a in kernel.adj.args]
    if len(kinds) != len(arguments):
        raise TypeError(f"{kernel.key} takes {len(kinds)} arguments, got {len(arguments)}")
    inputs = [
        flat(torch.empty(0, dtype=value.dtype), getattr(kind.dtype, "_length_", 1))
        if isinstance(value, Tensor)
        else value
        for kind, value in zip(kinds, arguments)
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
    return launch
