"""Values that are learned for each trained frame and interpolated on the frames between."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.cuda_graphs.device_constants import Time, constant
from hoigs.core.maths.frame_times import FrameTimes, frame_at
from hoigs.core.maths.rotations import axis_angle_to_quats
from hoigs.core.maths.splines import neighbours


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


class FrameCorrections(nn.Module):
    """A small rigid motion for each frame; all start at the identity.

    Between trained frames they are interpolated, as in PoseRefinement.

    Args:
        count, trained, times: as TrainedFrames.
    """

    def __init__(
        self, count: int, trained: Sequence[int] | None = None, times: FrameTimes = None
    ) -> None:
        super().__init__()
        self.turns = nn.Parameter(torch.zeros(count, 3))
        self.shifts = nn.Parameter(torch.zeros(count, 3))
        self.frames = TrainedFrames(count, trained, times)

    def forward(self, time: Time) -> tuple[Float[Tensor, " 4"], Float[Tensor, " 3"]]:
        """Rotation (wxyz) and translation, metres."""
        turn = self.frames.between(self.turns, time)
        return axis_angle_to_quats(turn), self.frames.between(self.shifts, time)
