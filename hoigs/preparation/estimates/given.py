"""Landmarks and masks as the source has them, of the chosen frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np
from jaxtyping import Bool, Float

from hoigs.core.interfaces.estimator import Landmarks
from hoigs.core.values.lens import Undistortion
from hoigs.preparation.body.landmarks import FrameFates, LandmarkTrack
from hoigs.preparation.masks.mask_stack import MaskStack
from hoigs.preparation.objects.ball import BallTrack
from hoigs.preparation.video.frames import Frames
from hoigs.preparation.video.source import NobodyFoundError


@dataclass(frozen=True)
class RawLandmarks:
    """Landmarks of the chosen frames, distortion still in; NaN where they were not found.

    Attributes:
        image: x, y, relative depth (pixels of the frames) and visibility. world: metres about the
            hips' middle, and visibility; NaN if the estimator sees the image only.
        source: for the report.
        fates: of the chosen frames, by their position.
    """

    image: Float[np.ndarray, "F 33 4"]
    world: Float[np.ndarray, "F 33 4"]
    source: str = "MediaPipe"
    fates: FrameFates = field(default_factory=FrameFates)

    def undistorted(self, undistort: Undistortion, positions: Sequence[int]) -> LandmarkTrack:
        """On the cameras' undistorted images; `positions` are those of frames with a camera."""
        rows = list(positions)
        image = self.image[rows].copy()
        image[..., :2] = undistort.pixels(image[..., :2])
        return LandmarkTrack.from_mediapipe(image, self.world[rows])


def chosen_landmarks(
    track: Landmarks, video: Frames, what: str, source: str = "MediaPipe"
) -> RawLandmarks:
    """Landmarks of a whole video, in its own pixels, as those of the chosen frames.

    Raises:
        NobodyFoundError: no person is found in them; `what` names where they come from.
    """
    image, world = track.image_xyzv[video.indices].astype(np.float64), track.world_xyzv
    image[..., :3] *= video.width / video.native_width
    if world is None:
        places = np.full_like(image, np.nan)
    else:
        places = world[video.indices].astype(np.float64)
    fates = FrameFates.at(track.lost, track.repaired, video.indices)
    raw = RawLandmarks(image, places, source, fates)
    if not LandmarkTrack.from_mediapipe(raw.image, raw.world).found.any():
        raise NobodyFoundError(
            f"{what}: no person was found in the {len(image)} chosen frames; the body of a person "
            "whose shoulders, hips and some of the limbs are in the picture can be fitted"
        )
    return raw


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
