"""Learnable corrections of the body poses that a clip brings (ExAvatar, Moon et al. 2024)."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.moment import BodyPose


class PoseRefinement(nn.Module):
    """Per-frame corrections of pose and translation, one of shape; all start at zero.

    Between frames, and on frames that are never trained on, corrections are interpolated linearly
    from the nearest trained frames, so that a test frame's own image has no part in its pose.

    Args:
        num_frames: F, uniform over [0, 1]. betas: shape coefficients of the body.
        trained: frames that are trained on; all when absent.
    """

    def __init__(self, num_frames: int, betas: int, trained: Sequence[int] | None = None) -> None:
        super().__init__()
        self.pose = nn.Parameter(torch.zeros(num_frames, 52, 3))
        self.transl = nn.Parameter(torch.zeros(num_frames, 3))
        self.betas = nn.Parameter(torch.zeros(betas))
        self.set_trained_frames(range(num_frames) if trained is None else trained)

    def set_trained_frames(self, indices: Sequence[int]) -> None:
        """Frames whose corrections are learned; the others are interpolated from these."""
        frames = sorted(set(indices))
        count = len(self.pose)
        if not frames or frames[0] < 0 or frames[-1] >= count:
            raise ValueError(
                f"trained frames must be some of 0..{count - 1}, got "
                f"{f'{frames[0]}..{frames[-1]}' if frames else 'none'}"
            )
        self.trained = frames

    def neighbours(self, time: float) -> tuple[int, int, float]:
        """Trained frames about `time` and the position between them; held at the ends."""
        frame = min(max(time, 0.0), 1.0) * (len(self.pose) - 1)
        if abs(frame - round(frame)) < 1e-4:  # float32 times must still hit their own frame
            frame = round(frame)
        after = bisect_left(self.trained, frame)
        high = self.trained[min(after, len(self.trained) - 1)]
        low = high if high <= frame else self.trained[max(after - 1, 0)]
        return low, high, (frame - low) / (high - low) if high > low else 0.0

    def forward(self, pose: BodyPose, time: float) -> BodyPose:
        """`pose` with the corrections at `time`; rotations are added as axis-angle, which is
        close to composing them while corrections stay small."""
        low, high, r = self.neighbours(time)
        turn: Float[Tensor, "52 3"] = torch.lerp(self.pose[low], self.pose[high], r)
        shift = torch.lerp(self.transl[low], self.transl[high], r)
        return pose.with_residual(turn[1:]).replace(
            global_orient=pose.global_orient + turn[0],
            transl=pose.transl + shift,
            betas=pose.betas + self.betas,
        )
