"""What a body fit gives: poses, how far they may be off, and what is said of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.values.moment import BodyPose


@dataclass(frozen=True)
class BodyErrors:
    """Within which a body is in four of five frames, metres; NaN where that is not known.

    Attributes:
        joints: mean distance of the seen joints from the true ones, both about the middle of the
            shoulders. distance: of that middle along the camera's axis.
    """

    joints: Float[Tensor, " F"]
    distance: Float[Tensor, " F"]

    @staticmethod
    def unknown(frames: int) -> BodyErrors:
        """Of a body of which nothing tells them."""
        return BodyErrors(torch.full((frames,), torch.nan), torch.full((frames,), torch.nan))

    def rows(self, frames: slice) -> BodyErrors:
        """Of some frames alone."""
        return BodyErrors(self.joints[frames], self.distance[frames])

    @staticmethod
    def joined(parts: Sequence[BodyErrors]) -> BodyErrors:
        """Of the frames of all parts, in order."""
        return BodyErrors(
            torch.cat([part.joints for part in parts]),
            torch.cat([part.distance for part in parts]),
        )


@dataclass(frozen=True)
class Joint:
    """Where a window takes over from the one before it, and how far both are apart there.

    Attributes:
        frame: the first that is the later window's own.
        metres, degrees: largest distance of a joint's places, and angle between its orientations in
            the world, by the two windows.
    """

    frame: int
    metres: float
    degrees: float


@dataclass(frozen=True)
class BodyFit:
    """A fitted body.

    Attributes:
        poses: batched over the frames, in a world of metres.
        residual_px: mean distance of visible landmarks per frame, pixels; NaN where unseen.
        scene_scale: metres a unit of the cameras' own world (1 unless it was requested).
        report: numbers for people.
        errors: within which the poses are.
        joints: of a fit in windows, where one follows another.
    """

    poses: BodyPose
    residual_px: Float[Tensor, " F"]
    scene_scale: float
    report: dict[str, Any]
    errors: BodyErrors
    joints: tuple[Joint, ...] = ()
