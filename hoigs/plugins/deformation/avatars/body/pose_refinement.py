"""Learnable corrections of a clip's body poses (ExAvatar, Moon et al. 2024, arXiv:2407.21686)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.cuda_graphs.device_constants import Time
from hoigs.core.maths.frame_times import FrameTimes
from hoigs.core.values.moment import BodyPose
from hoigs.plugins.deformation.avatars.body.trained_frames import TrainedFrames


class PoseRefinement(nn.Module):
    """Corrections of pose and translation for each frame, and one of shape; all start at zero.

    Between frames, and on frames that are not trained on, corrections are interpolated linearly
    from the nearest trained frames, so that the image of a test frame does not change its pose.

    Args:
        num_frames: F. betas: number of shape coefficients of the body.
        trained: frames that are trained on; all by default.
        times: of the F frames, in [0, 1]; None: uniform.
    """

    def __init__(
        self,
        num_frames: int,
        betas: int,
        trained: Sequence[int] | None = None,
        times: FrameTimes = None,
    ) -> None:
        super().__init__()
        self.pose = nn.Parameter(torch.zeros(num_frames, 52, 3))
        self.transl = nn.Parameter(torch.zeros(num_frames, 3))
        self.betas = nn.Parameter(torch.zeros(betas))
        self.frames = TrainedFrames(num_frames, trained, times)

    def forward(self, pose: BodyPose, time: Time) -> BodyPose:
        """`pose` with the corrections at `time`.

        Rotations are added as axis-angle, which is close to composing them while they are small.
        """
        turn: Float[Tensor, "52 3"] = self.frames.between(self.pose, time)
        shift = self.frames.between(self.transl, time)
        return pose.with_residual(turn[1:]).replace(
            global_orient=pose.global_orient + turn[0],
            transl=pose.transl + shift,
            betas=pose.betas + self.betas,
        )
