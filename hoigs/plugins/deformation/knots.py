"""Knots of a spline over time: uniform, or placed where the motion needs them (methods G.3)."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hoigs.core import spline
from hoigs.core.clock import Time, constant
from hoigs.core.rotation import slerp
from hoigs.plugins.deformation.resizing import Resizing

Times = Sequence[float] | Float[Tensor, " T"]
Spans = tuple[Int[Tensor, " T"], Float[Tensor, "T 1"], Float[Tensor, "T 1"]]


def one_time(time: Time) -> Times:
    """A time as one of many."""
    return time[None] if isinstance(time, Tensor) else [time]


class Knots(Resizing):
    """When the knots of one entity stand, and interpolation of values kept at them.

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
        times = [k / (count - 1) for k in range(count)]
        self.register_buffer("times", torch.tensor(times, dtype=torch.float64), persistent=movable)
        self._times = times

    def __len__(self) -> int:
        return len(self._times)

    def tolist(self) -> list[float]:
        return list(self._times)

    def place(self, times: Sequence[float]) -> None:
        """Move to other knots, increasing from 0 to 1."""
        if not self.movable:
            raise ValueError("these knots are uniform; make them with movable=True")
        self._times = list(times)
        self.times = self.times.new_tensor(self._times)

    def _load_from_state_dict(self, *args: Any) -> None:
        super()._load_from_state_dict(*args)
        if self.movable:
            self._times = self.times.tolist()

    def at(self, time: Time) -> tuple[Any, Any, Any]:
        """First knot k, position r in [0, 1] within [k, k + 1], and that interval's length in
        reference intervals: numbers, or 0-d tensors for a time that is one."""
        if not self.movable:
            k, r = spline.keyframe_position(time, len(self))
            return k, r, 1.0
        if isinstance(time, Tensor):
            time = time.clamp(0.0, 1.0)
            first = torch.searchsorted(self.times, time, right=True) - 1
            first = first.clamp(0, len(self) - 2)
            low, high = (x.squeeze(0) for x in spline.knot_pair(self.times[None], first))
            return first, (time - low) / (high - low), (high - low) / self.reference
        time = min(max(time, 0.0), 1.0)
        k = min(max(bisect_right(self._times, time) - 1, 0), len(self) - 2)
        length = self._times[k + 1] - self._times[k]
        return k, (time - self._times[k]) / length, length / self.reference

    def hermite(
        self,
        values: Float[Tensor, "N K D"],
        tangents: Float[Tensor, "N K D"],
        time: Time,
        *,
        derivative: bool = False,
    ) -> Float[Tensor, "N D"]:
        """Cubic Hermite spline with explicit tangents; its derivative is per reference interval."""
        k, r, h = self.at(time)
        pairs = spline.knot_pair(values, k), spline.knot_pair(tangents, k)
        return _hermite(*pairs, r, h, derivative)

    def catmull_rom(
        self, values: Float[Tensor, "N K D"], time: Time, *, derivative: bool = False
    ) -> Float[Tensor, "N D"]:
        """`hermite` with `differences` for tangents, from the four knots about `time` alone."""
        k, r, h = self.at(time)
        if isinstance(k, Tensor):  # which four is not known here: the tangents of all knots
            return self.hermite(values, self.differences(values), time, derivative=derivative)
        first, last = max(k - 1, 0), min(k + 3, len(self))
        window = values[:, first:last]
        tangents = self._differences(window, self.times[first:last])
        slopes = spline.knot_pair(tangents, k - first)
        return _hermite(spline.knot_pair(values, k), slopes, r, h, derivative)

    def differences(self, values: Float[Tensor, "N K D"]) -> Float[Tensor, "N K D"]:
        """Finite differences of the knots, one-sided at the ends; exact for parabolas between.

        With uniform knots (m_{k+1} - m_{k-1}) / 2, as `spline.catmull_rom_tangents`.
        """
        return self._differences(values, self.times)

    def _differences(self, values: Tensor, times: Tensor) -> Tensor:
        if not self.movable:
            return spline.catmull_rom_tangents(values)
        t = times.to(values) / self.reference
        h = (t[1:] - t[:-1])[:, None]
        slopes = (values[:, 1:] - values[:, :-1]) / h
        inner = (h[1:] * slopes[:, :-1] + h[:-1] * slopes[:, 1:]) / (h[1:] + h[:-1])
        return torch.cat((slopes[:, :1], inner, slopes[:, -1:]), dim=1)

    def linear(self, values: Float[Tensor, "N K ..."], time: Time) -> Float[Tensor, "N ..."]:
        k, r, _ = self.at(time)
        return spline.lerp(*spline.knot_pair(values, k), r)

    def slerp(self, quats: Float[Tensor, "N K 4"], time: Time) -> Float[Tensor, "N 4"]:
        k, r, _ = self.at(time)
        return slerp(*spline.knot_pair(quats, k), r)

    def hermite_at(
        self,
        values: Float[Tensor, "K D"],
        tangents: Float[Tensor, "K D"],
        times: Times,
        *,
        derivative: bool = False,
    ) -> Float[Tensor, "T D"]:
        """`hermite` of one curve at many times."""
        return self.hermite_in(self.spans(times, values), values, tangents, derivative=derivative)

    @staticmethod
    def hermite_in(
        spans: Spans,
        values: Float[Tensor, "K D"],
        tangents: Float[Tensor, "K D"],
        *,
        derivative: bool = False,
    ) -> Float[Tensor, "T D"]:
        """`hermite_at` of times whose `spans` are known."""
        k, r, h = spans
        after = k + 1
        controls = (values[k], h * tangents[k], values[after], h * tangents[after])
        weights = _weights(r, spline.HERMITE_RATES if derivative else spline.HERMITE)
        found = (weights[:, None] @ torch.stack(controls, 1)).squeeze(1)
        return found / h if derivative else found

    def spans(self, times: Times, like: Tensor) -> Spans:
        """`at` of many times: first knots, positions and lengths, these in the kind of `like`."""
        if not isinstance(times, Tensor):
            times = self.times.new_tensor(list(times))
        times = times.to(self.times).clamp(0.0, 1.0)
        if self.movable:
            first = torch.searchsorted(self.times, times, right=True) - 1
        else:
            first = (times * (len(self) - 1)).floor().long()
        first = first.clamp(0, len(self) - 2)
        low = self.times[first]
        length = self.times[first + 1] - low
        r, h = (times - low) / length, length / self.reference
        return first, r.to(like)[:, None], h.to(like)[:, None]

    def refit(
        self,
        samples: Float[Tensor, "S D"],
        sample_times: Sequence[float],
        *,
        free_tangents: bool,
    ) -> tuple[Float[Tensor, "K D"], Float[Tensor, "K D"]]:
        """Values and tangents at these knots of the spline nearest to samples: least squares.

        The tangents are faintly tied to finite differences, which decides what samples leave open.
        """
        count = len(self)
        kind: dict[str, Any] = {"dtype": torch.float64, "device": samples.device}
        target = samples.to(torch.float64)
        k, r, h = self.spans(sample_times, target)
        weights = _weights(r, spline.HERMITE) * torch.cat((torch.ones_like(h), h), 1).repeat(1, 2)
        columns = torch.stack((k, count + k, k + 1, count + k + 1), 1)
        rows = torch.zeros(len(target), 2 * count, **kind).scatter(1, columns, weights)
        eye = torch.eye(count, **kind)
        differences = self.differences(eye[None])[0]
        whole = torch.cat((eye, differences))  # values to values and their difference tangents
        if not free_tangents:
            solution = whole @ torch.linalg.lstsq(rows @ whole, target).solution
        else:
            ties = 1e-4 * torch.cat((differences, -eye), dim=1)
            target = torch.cat((target, target.new_zeros(count, target.shape[1])))
            solution = torch.linalg.lstsq(torch.cat((rows, ties)), target).solution
        values, tangents = solution.to(samples.dtype).split(count)
        return values, tangents


def _weights(r: Float[Tensor, "T 1"], table: Any) -> Float[Tensor, "T 4"]:
    """Of values and tangents at both ends of an interval, at r in it; `table` is spline.HERMITE or
    spline.HERMITE_RATES."""
    return r ** constant((0, 1, 2, 3), r) @ constant(table, r)


def _hermite(
    values: tuple[Tensor, Tensor],
    tangents: tuple[Tensor, Tensor],
    r: Any,
    h: Any,
    derivative: bool,
) -> Tensor:
    """One interval of length h: two values, two tangents."""
    if derivative:
        first, second, third, fourth = (x / h for x in spline.hermite_basis_derivative(r))
    else:
        first, second, third, fourth = spline.hermite_basis(r)
    return spline.weighted((first, second * h, third, fourth * h), values, tangents)
