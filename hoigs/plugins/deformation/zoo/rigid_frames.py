"""deformation:rigid-frames: a track, corrected frame by frame (HOLD, Fan et al. 2024)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Self

import torch
from torch import Tensor

from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.maths.rotations import move_rigidly, multiply_quats, normalize_quats
from hoigs.core.values.clip import ObjectTrack
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import Residual, displaced
from hoigs.plugins.deformation.rigid_track import RigidTrack
from hoigs.plugins.deformation.skinned_body import FrameCorrections, clip_settings


class RigidFrames(DeformationModel):
    """x(t) = R(t) p + T(t), with (R, T) the object's track times a learned correction a frame.

    The correction turns about the object's centre, in the world's axes, then shifts. Frames that
    are not trained on take what their trained neighbours learned.

    Args:
        track: where it starts from, a pose a frame.
        trained_frames: frames that are trained on; all when absent.
    """

    kinds = frozenset({"object"})
    rates: ClassVar[Mapping[str, str]] = {"corrections.turns": "pose", "corrections.shifts": "pose"}

    def __init__(self, *, track: ObjectTrack, trained_frames: Sequence[int] | None = None) -> None:
        super().__init__()
        self.track = RigidTrack(track)
        self.corrections = FrameCorrections(len(track.rotations), trained_frames, track.times)

    @classmethod
    def from_config(cls, config: ComponentConfig, context: BuildContext) -> Self:
        if context.object_track is None:
            raise ValueError(
                "deformation:rigid-frames needs a track; it suits entities of kind object"
            )
        trained = clip_settings(context.clip)["trained_frames"] if context.clip else None
        return cls(track=context.object_track, trained_frames=trained)

    def pose(self, time: float) -> tuple[Tensor, Tensor]:
        """Rotation (wxyz) [4] and translation [3], metres, object to world."""
        quat, place = self.track.at(time)
        turn, shift = self.corrections(time)
        return multiply_quats(turn, quat), place + shift

    def forward(
        self, canonical: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        quat, place = self.pose(moment.time)
        means, quats = move_rigidly(canonical.means, normalize_quats(canonical.quats), quat, place)
        return canonical.replace(means=displaced(means, residual), quats=quats)

    def regularizers(self) -> dict[str, Tensor]:
        """ "correction": mean squared turns, radians, and shifts, metres."""
        return {"correction": mean_square(self.corrections)}


def mean_square(corrections: FrameCorrections) -> Tensor:
    """Mean over the frames of squared turns, radians, plus squared shifts, metres."""
    values = torch.cat((corrections.turns, corrections.shifts), dim=1)
    return values.square().sum(-1).mean()
