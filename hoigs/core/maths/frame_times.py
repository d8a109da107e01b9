"""Values over the frames of a video: frame numbers of times, gaps, noise, and windows."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, overload

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hoigs.core.device import Time, constant
from hoigs.core.maths.splines import neighbours

FrameTimes = tuple[float, ...] | None  # of each frame, from 0 to 1, ascending; None: evenly spaced


@overload
def frame_at(time: float, count: int, times: FrameTimes) -> float: ...
@overload
def frame_at(time: Tensor, count: int, times: FrameTimes) -> Tensor: ...
def frame_at(time: Time, count: int, times: FrameTimes) -> Time:
    """The frame number of a time, between frames a fraction; held at the first and the last.

    Args:
        count: number of frames F. times: time of each.
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


def at_frame(
    values: Float[Tensor, "F ..."], time: Time, times: FrameTimes = None
) -> Float[Tensor, "..."]:
    """The value of the frame that is nearest to a time in [0, 1].

    Args:
        times: of the frames; None: uniform.
    """
    frame = frame_at(time, len(values), times)
    if isinstance(frame, Tensor):
        return values.index_select(0, frame.round().long()).squeeze(0)
    return values[round(frame)]


# Values that are learned for each trained frame and interpolated on the frames between.


class TrainedFrames:
    """Which of F frames are trained on.

    Args:
        count: F. trained: frames that are trained on; all by default.
        times: of the F frames, in [0, 1]; None: uniform.

    Raises:
        ValueError: no frame is trained on, or one that the clip does not have.
    """

    def __init__(
        self, count: int, trained: Sequence[int] | None = None, times: FrameTimes = None
    ) -> None:
        frames = sorted(set(range(count) if trained is None else trained))
        if not frames or frames[0] < 0 or frames[-1] >= count:
            raise ValueError(
                f"trained frames must be some of 0..{count - 1}, got "
                f"{f'{frames[0]}..{frames[-1]}' if frames else 'none'}"
            )
        self.count, self.trained, self.times = count, frames, times

    def neighbours(self, time: Time) -> tuple[Any, Any, Any]:
        """The trained frames before and after `time` and the position between them in [0, 1].

        Numbers, or 0-d tensors for a time that is one. Before the first trained frame and after
        the last both are that frame.
        """
        if isinstance(time, Tensor):
            return self._neighbours_on_device(time)
        frame = frame_at(time, self.count, self.times)
        if abs(frame - round(frame)) < 1e-4:  # times in float32 must still match their own frame
            frame = round(frame)
        low, high, r = neighbours(frame, self.trained)
        return self.trained[low], self.trained[high], r

    def _neighbours_on_device(self, time: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        trained = constant(tuple(self.trained), time, torch.long)
        frame = frame_at(time, self.count, self.times)
        frame = torch.where((frame - frame.round()).abs() < 1e-4, frame.round(), frame)
        after = torch.searchsorted(trained, frame.ceil().long())  # the first that is not earlier
        high = trained.index_select(0, after.clamp_max(len(trained) - 1)).squeeze(0)
        before = trained.index_select(0, (after - 1).clamp_min(0)).squeeze(0)
        low = torch.where(high <= frame, high, before)
        return low, high, (frame - low) / (high - low).clamp_min(1)

    def between(self, values: Float[Tensor, "F ..."], time: Time) -> Float[Tensor, "..."]:
        """`values`, one for each frame, at any time."""
        low, high, r = self.neighbours(time)
        if isinstance(low, Tensor):
            pair = values.index_select(0, torch.stack((low, high)))
            return torch.lerp(pair[0], pair[1], r.to(pair.dtype))
        return values[low] if low == high else torch.lerp(values[low], values[high], r)


# Values over the frames of a video: gaps interpolated, noise smoothed.


def fill_gaps(
    values: Float[np.ndarray, "F *shape"], known: Bool[np.ndarray, " F"]
) -> Float[np.ndarray, "F *shape"]:
    """Linear between known values, constant before the first and after the last."""
    frames, columns = np.arange(len(values)), values.reshape(len(values), -1).T
    filled = [np.interp(frames, frames[known], column[known]) for column in columns]
    return np.stack(filled, 1).reshape(values.shape)


def smooth(values: Float[np.ndarray, "F *shape"], window: int = 9) -> Float[np.ndarray, "F *shape"]:
    """A median of 5 frames against outliers, then parabolas over `window` frames against noise
    (Savitzky and Golay 1964); the median of all values where there are fewer than 5."""
    from scipy import signal  # on use: scipy takes a while to import

    count = len(values)
    if count < 5:
        return np.broadcast_to(np.median(values, axis=0), values.shape).copy()
    padded = np.pad(values, ((2, 2), *((0, 0),) * (values.ndim - 1)), mode="edge")
    median = np.median(np.lib.stride_tricks.sliding_window_view(padded, 5, axis=0), axis=-1)
    window = min(window, count if count % 2 else count - 1)
    return signal.savgol_filter(median, window, 2, axis=0, mode="interp")


# A long clip in windows: pieces of equal length that overlap.

LONGEST = 50  # frames of overlap, where none is given
LEAST = 4  # frames of overlap with which windows can be joined


@dataclass(frozen=True)
class Chunking:
    """How a clip is cut into windows.

    Attributes:
        chunk: frames of a window, at most. overlap: frames that neighbours share.

    Raises:
        ValueError: the windows are too short, share too little to be joined, or more than half.
    """

    chunk: int
    overlap: int

    @staticmethod
    def of(chunk: int, overlap: int | None = None) -> Chunking:
        """Without an overlap, a quarter of the window's frames, 50 at most."""
        return Chunking(chunk, max(LEAST, min(LONGEST, chunk // 4)) if overlap is None else overlap)

    def __post_init__(self) -> None:
        if self.chunk < 2 * LEAST:
            raise ValueError(f"a chunk of {self.chunk} frames; windows need {2 * LEAST} or more")
        if not LEAST <= self.overlap <= self.chunk // 2:
            raise ValueError(
                f"an overlap of {self.overlap} frames; windows of {self.chunk} frames have to share"
                f" {LEAST} or more to be joined, and may share {self.chunk // 2}, half of them"
            )

    def windows(self, frames: int) -> list[slice]:
        """Windows over `frames` frames, in order; one alone where all frames fit in it."""
        stride = self.chunk - self.overlap
        count = max(1, -(-(frames - self.overlap) // stride))
        starts = [k * (frames - self.overlap) // count for k in range(count)]
        stops = [start + self.overlap for start in starts[1:]] + [frames]
        return [slice(a, b) for a, b in zip(starts, stops, strict=True)]
