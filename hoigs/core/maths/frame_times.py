"""Frame numbers of times, where frames need not be evenly spaced."""

from __future__ import annotations

from bisect import bisect_right
from typing import overload

import torch
from torch import Tensor

from hoigs.core.cuda_graphs.device_constants import Time, constant

FrameTimes = tuple[float, ...] | None  # of each frame, from 0 to 1, ascending; None: evenly spaced


@overload
def frame_at(time: float, count: int, times: FrameTimes) -> float: ...
@overload
def frame_at(time: Tensor, count: int, times: FrameTimes) -> Tensor: ...
def frame_at(time: Time, count: int, times: FrameTimes) -> Time:
    """The frame number of a time, between frames a fraction; held at the first and the last.

    Args:
        count: F, the number of frames. times: of each.
    """
    if times is None or count < 2:
        if isinstance(time, Tensor):
            return time.clamp(0.0, 1.0) * (count - 1)
        return min(max(time, 0.0), 1.0) * (count - 1)
    if isinstance(time, Tensor):
        table = constant(times, time)
        before = (torch.searchsorted(table, time, right=True) - 1).clamp(0, count - 2)
        low, high = (table.index_select(0, before + i).squeeze(0) for i in (0, 1))
        return (before + (time - low) / (high - low)).clamp(0, count - 1)
    k = min(max(bisect_right(times, time) - 1, 0), count - 2)
    return min(max(k + (time - times[k]) / (times[k + 1] - times[k]), 0.0), count - 1.0)


def time_of(frame: float, count: int, times: FrameTimes) -> float:
    """The time of a frame number, between frames a fraction; the inverse of `frame_at`."""
    frame = min(max(frame, 0.0), count - 1.0)
    if times is None or count < 2:
        return frame / max(count - 1, 1)
    k = min(int(frame), count - 2)
    return times[k] + (frame - k) * (times[k + 1] - times[k])
