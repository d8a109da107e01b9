"""Calling Warp's kernels with little ado: a training step makes dozens of calls.

`wp.from_torch` and `wp.launch` take some microseconds for each argument. Descriptors and launches
are copied from one made by them instead, and only what changes is filled in.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from hoigs.rasterizers.warp.runtime import wp

_TYPES = {
    torch.float32: wp.float32,
    torch.int32: wp.int32,
    torch.int64: wp.int64,
    torch.uint8: wp.uint8,
}
_templates: dict[tuple[torch.dtype, int], tuple[type, bytes]] = {}
_launches: dict[Any, Any] = {}


def flat(tensor: Tensor, size: int = 1) -> Any:
    """A contiguous tensor as a flat array of numbers, or of vectors of `size` floats.

    The descriptor keeps the tensor alive.
    """
    key = (tensor.dtype, size)
    if key not in _templates:
        one = torch.zeros((1, size) if size > 1 else 1, dtype=tensor.dtype)
        dtype = wp.types.vector(size, wp.float32) if size > 1 else _TYPES[tensor.dtype]
        array = wp.from_torch(one, dtype=dtype, requires_grad=False, return_ctype=True)
        _templates[key] = (type(array), bytes(array))
    kind, template = _templates[key]
    array = kind.from_buffer_copy(template)
    array.data = tensor.data_ptr()
    array.shape[0] = tensor.numel() // size
    array._ref = tensor
    return array


def record(kernel: Any, dim: int, arguments: Sequence[Any]) -> Any:
    """A launch on the CPU, to be run later; it can run on several threads at once."""
    template = _launches.get(kernel)
    if template is None:
        template = wp.launch(kernel, dim=1, inputs=arguments, device="cpu", record_cmd=True)
        template.fwd_args = None
        template.params = [*template.params[:1], *(type(p) for p in template.params[1:])]
        _launches[kernel] = template
    launch = copy.copy(template)
    kinds = template.params[1:]
    if len(kinds) != len(arguments):
        raise TypeError(f"{kernel.key} takes {len(kinds)} arguments, got {len(arguments)}")
    launch.params = [
        template.params[0],
        *(x if type(x) is kind else kind(x) for kind, x in zip(kinds, arguments)),
    ]
    if dim != 1:
        launch.set_dim(dim)
    return launch
