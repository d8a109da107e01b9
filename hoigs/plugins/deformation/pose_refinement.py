"""Learnable corrections of the body poses that a clip brings (ExAvatar, Moon et al. 2024)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.clock import Time
from hoigs.core.moment import BodyPose
from hoigs.plugins.deformation.trained_frames import TrainedFrames


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
        self.frames = TrainedFrames(num_frames, trained)

    def set_trained_frames(self, indices: Sequence[int]) -> None:
        """Frames whose corrections are learned; the others are interpolated from these."""
        self.frames.set(indices)

    def forward(self, pose: BodyPose, time: Time) -> BodyPose:
        """`pose` with the corrections at `time`; rotations are added as axis-angle, which is
        close to composing them while corrections stay small."""
        turn: Float[Tensor, "52 3"] = self.frames.between(self.pose, time)
        shift = self.frames.between(self.transl, time)
        return pose.with_residual(turn[1:]).replace(
            global_orient=pose.global_orient + turn[0],
            transl=pose.transl + shift,
            betas=pose.betas + self.betas,
        )
