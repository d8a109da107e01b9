"""Cubic Hermite splines over time (HOIGS, Sec. "Spline-based Motion Modeling", Eq. 3 and 4).

Values and tangents are kept at K knots over the clip's time [0, 1], at uniform times or at others
(`hoigs.core.maths.splines.Knots`). An `Interval` is the position of a time among the knots; every
function reads only the knots that it needs there. Tangents and derivatives are per reference
interval: the paper's displacement per keyframe interval where knots are uniform.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.device import Time, replaceable
from hoigs.core.maths.rotations import slerp
from hoigs.core.parameters import OverTime, Resizing


class Interval(NamedTuple):
    """The position of a time between two knots.

    Numbers for a time that is a number, 0-d tensors for one that is a 0-d tensor; of T times
    tensors [T], [T, 1] and [T, 1].

    Attributes:
        k: index of the first of the two knots.
        r: position between knots k and k + 1, in [0, 1].
        length: distance of the two knots in reference intervals.
    """

    k: Any
    r: Any
    length: Any = 1.0


def keyframe_count(num_frames: int, step: int) -> int:
    """K = max(2, round((N_f - 1) / step) + 1): the count nearest to one keyframe every `step`
    frames (the paper's interval is 4; N_f - 1 is rarely a multiple of it)."""
    if num_frames < 1 or step < 1:
        raise ValueError(
            f"keyframe_count needs at least one frame and a step of 1, got {num_frames}, {step}"
        )
    return max(2, math.floor((num_frames - 1) / step + 0.5) + 1)


def keyframe_position(time: Time, keyframes: int) -> Interval:
    """The interval of `time` among uniform knots; times outside [0, 1] are held at the ends.

    t_s = t_n (K - 1), as in the paper, but k = min(floor(t_s), K - 2): its formula reads the
    missing knot K at the last frame.
    """
    if keyframes < 2:
        raise ValueError(f"a spline needs at least 2 keyframes, got {keyframes}")
    if isinstance(time, Tensor):
        on_device = time.clamp(0.0, 1.0) * (keyframes - 1)
        first = on_device.floor().clamp_max(keyframes - 2)
        return Interval(first.long(), on_device - first)
    scaled = min(max(time, 0.0), 1.0) * (keyframes - 1)
    k = min(math.floor(scaled), keyframes - 2)
    return Interval(k, scaled - k)


def neighbours(time: float, times: Sequence[float]) -> tuple[int, int, float]:
    """Indices of the entries of `times` about `time`, and the position between them in [0, 1].

    Held at the ends: before the first entry both are the first. An entry itself is both.

    Args:
        times: ascending, at least one.

    Raises:
        ValueError: `times` is empty.
    """
    if not times:
        raise ValueError("`times` is empty; expected at least one")
    after = bisect_left(times, time - 1e-6)  # float32 times must still hit their own entry
    high = min(after, len(times) - 1)
    low = high if times[high] <= time + 1e-6 else max(after - 1, 0)
    if low == high:
        return low, low, 0.0
    return low, high, (time - times[low]) / (times[high] - times[low])


def knot_pair(values: Float[Tensor, "N K ..."], k: Any) -> tuple[Tensor, Tensor]:
    """Values at knots k and k + 1, where k is a number or a 0-d tensor."""
    if isinstance(k, Tensor):
        return values.index_select(1, k).squeeze(1), values.index_select(1, k + 1).squeeze(1)
    first, second = values[:, k : k + 2].unbind(1)  # its gradient is one sum less than of two reads
    return first, second


@replaceable
def hermite_weights(r: Any, *, derivative: bool = False) -> tuple[Any, Any, Any, Any]:
    """The basis functions h00, h10, h01, h11 at r: weights of m_k, tau_k, m_{k+1}, tau_{k+1} in
    CHS (HOIGS, Eq. 4), or their derivatives.

    Args:
        r: a number or a tensor, t_r of the paper; each weight has its shape.
    """
    if derivative:
        return (6 * r**2 - 6 * r, 1 - 4 * r + 3 * r**2, 6 * r - 6 * r**2, 3 * r**2 - 2 * r)
    h00 = 1 - 3 * r**2 + 2 * r**3
    h10 = r - 2 * r**2 + r**3
    h01 = 3 * r**2 - 2 * r**3
    h11 = r**3 - r**2
    return h00, h10, h01, h11


def cubic_hermite(
    values: Float[Tensor, "..."],
    tangents: Float[Tensor, "..."],
    at: Interval,
    *,
    derivative: bool = False,
) -> Float[Tensor, "... D"]:
    """CHS(t, m) = h00 m_k + h10 tau_k + h01 m_{k+1} + h11 tau_{k+1} (HOIGS, Eq. 4) with explicit
    tangents, or its derivative per reference interval.

    Args:
        values, tangents: [N, K, D] of N curves, read at one time: the result is [N, D]; or [K, D]
            of one curve, read at T times: the result is [T, D].
        at: the interval of the one time, or of the T times.
    """
    k, r, length = at
    if not isinstance(r, Tensor) or r.dim() == 0:
        pairs = knot_pair(values, k), knot_pair(tangents, k)
        return _between(*pairs, r, length, derivative)
    # one product for all times: sums of four terms would be seven operations instead of two
    after = k + 1
    ends = (values[k], length * tangents[k], values[after], length * tangents[after])
    weights = torch.cat(hermite_weights(r, derivative=derivative), -1)
    found = (weights[:, None] @ torch.stack(ends, 1)).squeeze(1)
    return found / length if derivative else found


def _between(
    values: tuple[Tensor, Tensor],
    tangents: tuple[Tensor, Tensor],
    r: Any,
    length: Any,
    derivative: bool,
) -> Tensor:
    """`cubic_hermite` of the interval whose two values and tangents these are."""
    h00, h10, h01, h11 = hermite_weights(r, derivative=derivative)
    if isinstance(length, Tensor) or length != 1.0:  # of tensors each of these is an operation
        if derivative:
            h00, h01 = h00 / length, h01 / length
        else:
            h10, h11 = h10 * length, h11 * length
    total: Tensor = h00 * values[0] + h10 * tangents[0] + h01 * values[1] + h11 * tangents[1]
    return total


def finite_differences(
    values: Float[Tensor, "N K D"], times: Float[Tensor, " K"] | None = None
) -> Float[Tensor, "N K D"]:
    """tau_k = (m_{k+1} - m_{k-1}) / 2, one-sided at both ends: the finite differences that the
    paper compares with learned tangents.

    Args:
        times: times of non-uniform knots, in reference intervals. Parabolas are then still
            exact at inner knots.
    """
    steps = values[:, 1:] - values[:, :-1]
    if times is None:
        inner = 0.5 * (steps[:, 1:] + steps[:, :-1])
        return torch.cat((steps[:, :1], inner, steps[:, -1:]), dim=1)
    lengths = times.diff()[:, None]
    slopes = steps / lengths
    before, after = lengths[:-1], lengths[1:]
    inner = (after * slopes[:, :-1] + before * slopes[:, 1:]) / (after + before)
    return torch.cat((slopes[:, :1], inner, slopes[:, -1:]), dim=1)


def catmull_rom(
    values: Float[Tensor, "N K D"],
    at: Interval,
    times: Float[Tensor, " K"] | None = None,
    *,
    derivative: bool = False,
) -> Float[Tensor, "N D"]:
    """`cubic_hermite` with `finite_differences`, from the four knots about one time where they
    are known.

    Args:
        times: as for `finite_differences`.
    """
    k, r, length = at
    last = values.shape[1] - 1
    if not isinstance(k, Tensor):
        first, end = max(k - 1, 0), min(k + 3, last + 1)
        window = values[:, first:end]
        tangents = finite_differences(window, None if times is None else times[first:end])
        pairs = knot_pair(values, k), knot_pair(tangents, k - first)
        return _between(*pairs, r, length, derivative)
    if times is not None:
        return cubic_hermite(values, finite_differences(values, times), at, derivative=derivative)
    near = (k + torch.arange(-1, 3, device=k.device)).clamp(0, last)
    window = values.index_select(1, near)
    spans = (near[2:] - near[:2])[:, None].to(values)  # 2 intervals, or 1 at an end of the spline
    tangents = (window[:, 2:] - window[:, :2]) / spans
    pairs = knot_pair(window, 1), knot_pair(tangents, 0)
    return _between(*pairs, r, length, derivative)


def linear(values: Float[Tensor, "N K ..."], at: Interval) -> Float[Tensor, "N ..."]:
    """Piecewise linear interpolation over the knots."""
    return lerp(*knot_pair(values, at.k), at.r)


def lerp(low: Tensor, high: Tensor, r: Any) -> Tensor:
    """torch.lerp for a position r that is a number or a 0-d tensor of any type."""
    return torch.lerp(low, high, r.to(low.dtype) if isinstance(r, Tensor) else r)


def accelerations(values: Float[Tensor, "N K D"]) -> Float[Tensor, "N K2 D"]:
    """Second differences of the knots, m_{k+1} - 2 m_k + m_{k-1}; empty for two knots."""
    return values[:, 2:] - 2 * values[:, 1:-1] + values[:, :-2]


# Knots of a spline over the clip's time: uniform, or at times that may change in training.

Times = Sequence[float] | Float[Tensor, " T"]


def uniform_times(count: int) -> list[float]:
    """Times of `count` uniform knots over [0, 1]."""
    return [k / (count - 1) for k in range(count)]


def one_time(time: Time) -> Times:
    """A time as a batch of one."""
    return time[None] if isinstance(time, Tensor) else [time]


class Knots(OverTime, Resizing):
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
        self.keep_rows(count)  # of values kept at uniform knots

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
            at = keyframe_position(time, self.rows.count)
            return at._replace(k=at.k - self.rows.first)
        if isinstance(time, Tensor):
            time = time.clamp(0.0, 1.0)
            first = torch.searchsorted(self.times, time, right=True) - 1
            first = first.clamp(0, len(self) - 2)
            low, high = (x.squeeze(0) for x in knot_pair(self.times[None], first))
            return Interval(first, (time - low) / (high - low), (high - low) / self.reference)
        time = min(max(time, 0.0), 1.0)
        k = min(max(bisect_right(self._times, time) - 1, 0), len(self) - 2)
        length = self._times[k + 1] - self._times[k]
        return Interval(k, (time - self._times[k]) / length, length / self.reference)

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
        return cubic_hermite(values, tangents, self.at(time), derivative=derivative)

    def catmull_rom(
        self, values: Float[Tensor, "N K D"], time: Time, *, derivative: bool = False
    ) -> Float[Tensor, "N D"]:
        """`hermite` with `differences` for tangents."""
        times = self._reference_times(values)
        return catmull_rom(values, self.at(time), times, derivative=derivative)

    def differences(self, values: Float[Tensor, "N K D"]) -> Float[Tensor, "N K D"]:
        """`splines.finite_differences` of these knots."""
        return finite_differences(values, self._reference_times(values))

    def _reference_times(self, like: Tensor) -> Tensor | None:
        """Times in reference intervals; None where they are uniform."""
        return self.times.to(like) / self.reference if self.movable else None

    def linear(self, values: Float[Tensor, "N K ..."], time: Time) -> Float[Tensor, "N ..."]:
        return linear(values, self.at(time))

    def slerp(self, quats: Float[Tensor, "N K 4"], time: Time) -> Float[Tensor, "N 4"]:
        k, r, _ = self.at(time)
        return slerp(*knot_pair(quats, k), r)

    def fit(
        self,
        samples: Float[Tensor, "S D"],
        times: Times,
        *,
        free_tangents: bool,
        weights: Float[Tensor, " S"] | None = None,
        smoothness: float = 1e-3,
    ) -> tuple[Float[Tensor, "K D"], Float[Tensor, "K D"]]:
        """Values and tangents of the spline with these knots that is nearest to samples at `times`:
        linear least squares in float64.

        Reading a motion off at the knots instead, with finite differences for tangents, cuts its
        corners: on a box swung at arm's length, a keyframe every 4 frames, that is off by 27 mm at
        worst, the fit by 1 mm.

        Args:
            free_tangents: fit tangents too; else they are the finite differences of the values.
            weights: sample weights; 1 by default.
            smoothness: weight of tangents against finite differences, and of accelerations, a
                hundredth of that; it decides what the samples leave open.
        """
        k, r, length = self.at_times(times, self.times)
        count, target = len(self), samples.to(torch.float64)
        h00, h10, h01, h11 = hermite_weights(r)
        basis = torch.cat((h00, h10 * length, h01, h11 * length), 1)
        columns = torch.stack((k, count + k, k + 1, count + k + 1), 1)
        rows = target.new_zeros(len(target), 2 * count).scatter(1, columns, basis)
        if weights is not None:
            scale = weights.to(target).sqrt()[:, None]
            rows, target = scale * rows, scale * target
        eye = torch.eye(count).to(target)
        differences = self.differences(eye[None])[0]  # as a matrix
        complete = torch.cat((eye, differences))  # from values to values and their differences
        bends = 0.1 * smoothness**0.5 * accelerations(eye[None])[0]
        if free_tangents:
            ties = smoothness**0.5 * torch.cat((differences, -eye), dim=1)
            system = torch.cat((rows, ties, torch.cat((bends, torch.zeros_like(bends)), dim=1)))
        else:
            system = torch.cat((rows @ complete, bends))
        target = torch.cat((target, target.new_zeros(len(system) - len(target), target.shape[1])))
        solution = torch.linalg.lstsq(system, target).solution
        if not free_tangents:
            solution = complete @ solution
        values, tangents = solution.to(samples.dtype).split(count)
        return values, tangents
