"""Times that may be 0-d tensors, and constants that stay on the device.

A moment's time is usually a Python number. A captured CUDA graph would repeat that number at every
replay, so graphs get the time as a 0-d tensor on the device, which is overwritten before each
replay. Functions that take a `Time` accept both and never copy a tensor back to the host.
"""

from __future__ import annotations

import functools
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

Time = float | Float[Tensor, ""]


def filled(like: Float[Tensor, "..."], shape: tuple[int, ...], time: Time) -> Float[Tensor, "..."]:
    """A tensor of `shape`, with the dtype and device of `like`, filled with `time`."""
    if isinstance(time, Tensor):
        return time.to(like.dtype).expand(shape)
    return like.new_full(shape, time)


def constant(values: Any, like: Tensor, dtype: torch.dtype | None = None) -> Tensor:
    """A cached tensor of (nested) tuples of numbers on the device of `like`; never write to it.

    A fresh tensor would be copied from the host, which waits for all work queued on the device.

    Args:
        dtype: that of `like` by default.
    """
    return _constant(values, like.dtype if dtype is None else dtype, like.device)


@functools.cache  # never freed: captured graphs go on reading these tensors
def _constant(values: Any, dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        return torch.tensor(values, dtype=dtype, device=device)
