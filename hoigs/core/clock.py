"""Times that a device can be told without a word from the host, and constants kept on it.

A moment's time is a number. Playback draws many moments with one recorded list of kernels, into
which a number would be written once and for all; it asks with a 0-d tensor instead, whose value is
filled in before each frame. What takes a `Time` takes both, and reads no tensor back to the host.
"""

from __future__ import annotations

import functools
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

Time = float | Float[Tensor, ""]


def filled(like: Float[Tensor, "..."], shape: tuple[int, ...], time: Time) -> Float[Tensor, "..."]:
    """A tensor of `shape`, in the kind of `like`, that holds `time` everywhere."""
    if isinstance(time, Tensor):
        return time.to(like.dtype).expand(shape)
    return like.new_full(shape, time)


def constant(values: Any, like: Tensor, dtype: torch.dtype | None = None) -> Tensor:
    """(Nested) tuples of numbers as a tensor on the device of `like`, made once; never write to it.

    Making it anew would wait for everything that the device has been asked before.

    Args:
        dtype: that of `like` by default.
    """
    return _constant(values, like.dtype if dtype is None else dtype, like.device)


@functools.cache  # for good: graphs that were captured with a constant go on reading it
def _constant(values: Any, dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        return torch.tensor(values, dtype=dtype, device=device)
