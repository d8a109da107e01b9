"""Launching Warp's kernels on a CPU with little overhead: a training step makes dozens of launches.

`wp.from_torch` and `wp.launch` take some microseconds for each argument. Here descriptors and
launches are copied from a template that they made once, and only what differs is filled in.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from hoigs.core.cpu_kernels.runtime import wp

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
