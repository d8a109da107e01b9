"""Landmarks and masks as the source has them, of the chosen frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np
import torch
from jaxtyping import Bool, Float

from hoigs.core.interfaces import estimator
from hoigs.core.values.lens import Undistortion
from hoigs.preparation.body.landmarks import FrameFates, Landmarks
from hoigs.preparation.masks.mask_stack import MaskStack
from hoigs.preparation.objects.ball import BallTrack
from hoigs.preparation.video.frames import Frames
from hoigs.preparation.video.source import NobodyFoundError


def chosen_landmarks(
    track: estimator.Landmarks, video: Frames, what: str, source: str = "MediaPipe"
) -> Landmarks:
    """Landmarks of a whole video, in its own pixels, as those of the chosen frames, at their size.

    Raises:
        NobodyFoundError: no person is found in them; `what` names where they come from.
    """
    image = track.image_xyzv[video.indices].astype(np.float64)[..., [0, 1, 3]]
    image[..., :2] *= video.width / video.native_width
    if track.world_xyzv is None:
        world = np.full_like(image, np.nan)
    else:
        world = track.world_xyzv[video.indices].astype(np.float64)[..., :3]
    fates = FrameFates.at(track.lost, track.repaired, video.indices)
    found = Landmarks(torch.from_numpy(image), torch.from_numpy(world), source, fates)
    if not found.found.any():
        raise NobodyFoundError(
            f"{what}: no person was found in the {len(image)} chosen frames; the body of a person "
            "whose shoulders, hips and some of the limbs are in the picture can be fitted"
        )
    return found


@dataclass(frozen=True)
class GivenMasks:
    """Masks as the source has them: together, or the person's and perhaps the object's apart; and
    those of further people, all in one."""

    together: MaskStack | None = None
    human: MaskStack | None = None
    object: MaskStack | None = None
    others: MaskStack | None = None

    def named(self) -> dict[str, MaskStack]:
        """Those that there are, by the name of the field."""
        return {f.name: m for f in fields(self) if (m := getattr(self, f.name)) is not None}

    def moving(self, frame: int) -> Bool[np.ndarray, "H W"]:
        """Everything masked in a frame: what does not stand still with the scene."""
        return np.logical_or.reduce([stack[frame] for stack in self.named().values()])

    def persons(self, ball: BallTrack | None) -> MaskStack | None:
        """The person's, or the nearest to it that is known before the body is fitted: with what
        they hold, but without a tracked ball. None where only the object is masked."""
        if self.human is not None or self.together is None:
            return self.human
        stack = MaskStack()
        for frame, mask in enumerate(self.together):
            if self.object is not None:
                mask = mask & ~self.object[frame]
            if ball is not None:
                mask = mask & ~ball.disc(frame, mask.shape[1], mask.shape[0])
            stack.append(mask)
        return stack

    def undistorted(self, undistort: Undistortion, positions: Sequence[int]) -> GivenMasks:
        """On the cameras' undistorted images; `positions` are those of frames with a camera."""
        return GivenMasks(
            **{
                name: MaskStack(undistort.mask(stack[i]) for i in positions)
                for name, stack in self.named().items()
            }
        )


@dataclass(frozen=True)
class FrameEstimates:
    """Landmarks and masks of the frames: as found, or on the cameras' undistorted images.

    Attributes:
        landmarks: by person, the first one's first; none: nobody is looked for, and the person's
            masks are empty.
        further: masks of people but the first, by name.
    """

    landmarks: dict[str, Landmarks]
    masks: GivenMasks
    further: dict[str, MaskStack] = field(default_factory=dict)

    @property
    def person(self) -> Landmarks | None:
        """The first person's."""
        return next(iter(self.landmarks.values()), None)

    def undistorted(self, undistort: Undistortion, positions: Sequence[int]) -> FrameEstimates:
        """On the cameras' undistorted images; `positions` are those of frames with a camera."""
        return FrameEstimates(
            {name: one.undistorted(undistort, positions) for name, one in self.landmarks.items()},
            self.masks.undistorted(undistort, positions),
            {
                name: MaskStack(undistort.mask(stack[i]) for i in positions)
                for name, stack in self.further.items()
            },
        )


@dataclass(frozen=True)
class FoundObject:
    """The object's masks from an estimator of its own, of the chosen frames, distortion still in.

    Attributes:
        confidence: of each chosen frame, 0..1; None: not computed.
        boxes: frame of the video and box x0, y0, x1, y1 in its pixels where the object was proposed
            because no prompt said where it is.
        notes: for the report.
        further: other objects by name (`PrepareOptions.further_objects`).
    """

    masks: MaskStack
    provenance: str
    confidence: Float[np.ndarray, " F"] | None = None
    boxes: list[tuple[float, ...]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    further: dict[str, FoundObject] = field(default_factory=dict)
