"""What is learned for each trained frame, and followed by the frames between them."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.clock import Time, constant
from hoigs.core.rotation import axis_angle_to_quats


class TrainedFrames:
    """Which of F frames, uniform over [0, 1], are learned from.

    Args:
        count: F. trained: frames that are trained on; all when absent.
    """

    def __init__(self, count: int, trained: Sequence[int] | None = None) -> None:
        self.count = count
        self.set(range(count) if trained is None else trained)

    def set(self, indices: Sequence[int]) -> None:
        frames = sorted(set(indices))
        if not frames or frames[0] < 0 or frames[-1] >= self.count:
            raise ValueError(
                f"trained frames must be some of 0..{self.count - 1}, got "
                f"{f'{frames[0]}..{frames[-1]}' if frames else 'none'}"
            )
        self.trained = frames

    def neighbours(self, time: Time) -> tuple[Any, Any, Any]:
        """Trained frames about `time` and the position between them; held at the ends.

        Numbers, or 0-d tensors for a time that is one.
        """
        if isinstance(time, Tensor):
            return self._neighbours_on_device(time)
        frame = min(max(time, 0.0), 1.0) * (self.count - 1)
        if abs(frame - round(frame)) < 1e-4:  # float32 times must still hit their own frame
            frame = round(frame)
        after = bisect_left(self.trained, frame)
        high = self.trained[min(after, len(self.trained) - 1)]
        low = high if high <= frame else self.trained[max(after - 1, 0)]
        return low, high, (frame - low) / (high - low) if high > low else 0.0

    def _neighbours_on_device(self, time: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        trained = constant(tuple(self.trained), time, torch.long)
        frame = time.clamp(0.0, 1.0) * (self.count - 1)
        frame = torch.where((frame - frame.round()).abs() < 1e-4, frame.round(), frame)
        after = torch.searchsorted(trained, frame.ceil().long())  # the first that is no earlier
        high = trained.index_select(0, after.clamp_max(len(trained) - 1)).squeeze(0)
        before = trained.index_select(0, (after - 1).clamp_min(0)).squeeze(0)
        low = torch.where(high <= frame, high, before)
        return low, high, (frame - low) / (high - low).clamp_min(1)

    def between(self, values: Float[Tensor, "F ..."], time: Time) -> Float[Tensor, "..."]:
        """One value a frame, at any time."""
        low, high, r = self.neighbours(time)
        if isinstance(low, Tensor):
            pair = values.index_select(0, torch.stack((low, high)))
            return torch.lerp(pair[0], pair[1], r.to(pair.dtype))
        return values[low] if low == high else torch.lerp(values[low], values[high], r)


class FrameCorrections(nn.Module):
    """A small rigid motion for each frame; all start at none.

    On frames that are never trained on they are interpolated from the trained ones, so that a test
    frame's own image has no part in its pose.

    Args:
        count, trained: as TrainedFrames.
    """

    def __init__(self, count: int, trained: Sequence[int] | None = None) -> None:
        super().__init__()
        self.turns = nn.Parameter(torch.zeros(count, 3))
        self.shifts = nn.Parameter(torch.zeros(count, 3))
        self.frames = TrainedFrames(count, trained)

    def forward(self, time: Time) -> tuple[Float[Tensor, " 4"], Float[Tensor, " 3"]]:
        """Rotation (wxyz) and translation, metres."""
        turn = self.frames.between(self.turns, time)
        return axis_angle_to_quats(turn), self.frames.between(self.shifts, time)
