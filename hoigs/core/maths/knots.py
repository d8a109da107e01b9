"""Knots of a spline over the clip's time: uniform, or at times that may change in training."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.cuda_graphs.device_constants import Time
from hoigs.core.maths import splines
from hoigs.core.maths.rotations import slerp
from hoigs.core.maths.splines import Interval
from hoigs.core.resizing import Resizing
from hoigs.core.time_rows import TimeRows

Times = Sequence[float] | Float[Tensor, " T"]


def uniform_times(count: int) -> list[float]:
    """Times of `count` uniform knots over [0, 1]."""
    return [k / (count - 1) for k in range(count)]


def one_time(time: Time) -> Times:
    """A time as a batch of one."""
    return time[None] if isinstance(time, Tensor) else [time]


class Knots(Resizing):
    """Times of the knots of one entity, and interpolation of the values kept at them.

    Tangents are displacements per reference interval, 1 / (count - 1) of the clip, whatever the
    distance of the knots: with uniform knots that is the paper's displacement per keyframe
    interval, and inserting or removing a knot leaves the tangents of the others as they are.
    Times outside [0, 1] are held at the ends.

    Args:
        count: K at the start, uniform over [0, 1].
        movable: knots may be inserted and removed; their times are then part of checkpoints.
    """

    resizes: ClassVar[Mapping[str, int]] = {"times": 0}

    times: Tensor

    def __init__(self, count: int, *, movable: bool = False) -> None:
        super().__init__()
        if count < 2:
            raise ValueError(f"a spline needs at least 2 keyframes, got {count}")
        self.reference, self.movable = 1.0 / (count - 1), movable
        times = uniform_times(count)
        self.register_buffer("times", torch.tensor(times, dtype=torch.float64), persistent=movable)
        self._times = times
        self.rows = TimeRows(count)  # of values kept at uniform knots

    def __len__(self) -> int:
        return len(self._times)

    def tolist(self) -> list[float]:
        return list(self._times)

    def place(self, times: Sequence[float]) -> None:
        """Move to other times, increasing from 0 to 1."""
        if not self.movable:
            raise ValueError("these knots are uniform; make them with movable=True")
        self._times = list(times)
        self.times = self.times.new_tensor(self._times)

    def placed(self, times: Sequence[float]) -> Knots:
        """Other movable knots at `times`, with the same reference interval."""
        knots = Knots(2, movable=True).to(self.times.device)
        knots.reference = self.reference
        knots.place(times)
        return knots

    def _load_from_state_dict(self, *args: Any) -> None:
        super()._load_from_state_dict(*args)
        if self.movable:
            self._times = self.times.tolist()

    def at(self, time: Time) -> Interval:
        """The interval of one time."""
        if not self.movable:
            return self.rows_about(time, self.rows)
        if isinstance(time, Tensor):
            time = time.clamp(0.0, 1.0)
            first = torch.searchsorted(self.times, time, right=True) - 1
            first = first.clamp(0, len(self) - 2)
            low, high = (x.squeeze(0) for x in splines.knot_pair(self.times[None], first))
            return Interval(first, (time - low) / (high - low), (high - low) / self.reference)
        time = min(max(time, 0.0), 1.0)
        k = min(max(bisect_right(self._times, time) - 1, 0), len(self) - 2)
        length = self._times[k + 1] - self._times[k]
        return Interval(k, (time - self._times[k]) / length, length / self.reference)

    @staticmethod
    def rows_about(time: Time, rows: TimeRows) -> Interval:
        """The interval of one time among uniform knots, whose number counts from `rows.first`."""
        at = splines.keyframe_position(time, rows.count)
        return at._replace(k=at.k - rows.first)

    def at_times(self, times: Times, like: Tensor) -> Interval:
        """The intervals of T times; positions and lengths in the data type of `like`."""
        if not isinstance(times, Tensor):
            times = self.times.new_tensor(list(times))
        times = times.to(self.times).clamp(0.0, 1.0)
        first = (torch.searchsorted(self.times, times, right=True) - 1).clamp(0, len(self) - 2)
        low = self.times[first]
        length = self.times[first + 1] - low
        r, length = (times - low) / length, length / self.reference
        return Interval(first, r.to(like)[:, None], length.to(like)[:, None])

    def hermite(
        self,
        values: Float[Tensor, "N K D"],
        tangents: Float[Tensor, "N K D"],
        time: Time,
        *,
        derivative: bool = False,
    ) -> Float[Tensor, "N D"]:
        """`splines.cubic_hermite` of N curves at one time."""
        return splines.cubic_hermite(values, tangents, self.at(time), derivative=derivative)

    def catmull_rom(
        self, values: Float[Tensor, "N K D"], time: Time, *, derivative: bool = False
    ) -> Float[Tensor, "N D"]:
        """`hermite` with `differences` for tangents."""
        times = self._reference_times(values)
        return splines.catmull_rom(values, self.at(time), times, derivative=derivative)

    def differences(self, values: Float[Tensor, "N K D"]) -> Float[Tensor, "N K D"]:
        """`splines.finite_differences` of these knots."""
        return splines.finite_differences(values, self._reference_times(values))

    def _reference_times(self, like: Tensor) -> Tensor | None:
        """Times in reference intervals; None where they are uniform."""
        return self.times.to(like) / self.reference if self.movable else None

    def linear(self, values: Float[Tensor, "N K ..."], time: Time) -> Float[Tensor, "N ..."]:
        return splines.linear(values, self.at(time))

    def slerp(self, quats: Float[Tensor, "N K 4"], time: Time) -> Float[Tensor, "N 4"]:
        k, r, _ = self.at(time)
        return slerp(*splines.knot_pair(quats, k), r)

    def fit(
        self,
        samples: Float[Tensor, "S D"],
        times: Times,
        *,
        free_tangents: bool,
        weights: Float[Tensor, " S"] | None = None,
        smoothness: float = 1e-3,
    ) -> tuple[Float[Tensor, "K D"], Float[Tensor, "K D"]]:
        """`splines.fit` of samples at `times` with these knots."""
        eye = torch.eye(len(self)).to(self.times)
        return splines.fit(
            samples,
            self.at_times(times, self.times),
            self.differences(eye[None])[0],
            free_tangents=free_tangents,
            weights=weights,
            smoothness=smoothness,
        )
