"""deformation:rigid-frames: a track, corrected frame by frame (HOLD, Fan et al. 2024)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Self

import torch
from torch import Tensor

from hoigs.core.clip import ObjectTrack
from hoigs.core.config import ComponentConfig
from hoigs.core.context import BuildContext
from hoigs.core.deformation import DeformationModel
from hoigs.core.gaussians import Gaussians
from hoigs.core.interaction import Residual
from hoigs.core.moment import Moment
from hoigs.core.rotation import multiply_quats, normalize_quats, quats_to_matrices
from hoigs.plugins.deformation.rigid_track import RigidTrack
from hoigs.plugins.deformation.skinned_body import clip_settings
from hoigs.plugins.deformation.trained_frames import FrameCorrections


class RigidFramesConfig(ComponentConfig):
    """Nothing to set."""


class RigidFrames(DeformationModel):
    """x(t) = R(t) p + T(t), with (R, T) the object's track times a learned correction a frame.

    The correction turns about the object's centre, in the world's axes, then shifts. Frames that
    are not trained on take what their trained neighbours learned.

    Args:
        track: where it starts from, a pose a frame.
        trained_frames: frames that are trained on; all when absent.
    """

    rates: ClassVar[Mapping[str, str]] = {
        "corrections.turns": "pose",
        "corrections.shifts": "pose",
    }

    def __init__(self, track: ObjectTrack, trained_frames: Sequence[int] | None = None) -> None:
        super().__init__()
        self.track = RigidTrack(track)
        self.corrections = FrameCorrections(len(track.rotations), trained_frames)

    @classmethod
    def from_config(cls, config: RigidFramesConfig, context: BuildContext) -> Self:
        del config
        if context.object_track is None:
            raise ValueError(
                "deformation:rigid-frames needs a track; it suits entities of kind object"
            )
        trained = clip_settings(context.clip)["trained_frames"] if context.clip else None
        return cls(context.object_track, trained)

    def pose(self, time: float) -> tuple[Tensor, Tensor]:
        """Rotation (wxyz) [4] and translation [3], metres, object to world."""
        quat, place = self.track.at(time)
        turn, shift = self.corrections(time)
        return multiply_quats(turn, quat), place + shift

    def forward(
        self, rest: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        quat, place = self.pose(moment.time)
        means = rest.means @ quats_to_matrices(quat).mT + place
        if residual is not None and residual.means is not None:
            means = means + residual.means
        quats = normalize_quats(rest.quats)
        return rest.replace(means=means, quats=multiply_quats(quat.expand_as(quats), quats))

    def regularizers(self) -> dict[str, Tensor]:
        """ "correction": mean squared turns, radians, and shifts, metres."""
        values = torch.cat((self.corrections.turns, self.corrections.shifts), dim=1)
        return {"correction": values.square().sum(-1).mean()}
