"""The person's and the object's masks, from whatever masks the source has."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool
from scipy import ndimage

from hoigs.preparation.cameras.camera_track import CameraTrack
from hoigs.preparation.masks.mask_stack import MaskStack, largest_parts
from hoigs.preparation.masks.separate import Images, separate
from hoigs.preparation.objects.ball import BallTrack


@dataclass(frozen=True)
class GivenMasks:
    """Masks as the source has them: together, or the person's and perhaps the object's apart."""

    together: MaskStack | None = None
    human: MaskStack | None = None
    object: MaskStack | None = None

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

    def undistorted(self, track: CameraTrack) -> GivenMasks:
        """On the cameras' undistorted images, without the frames that have no camera."""
        return GivenMasks(
            **{
                name: MaskStack(track.undistort.mask(stack[i]) for i in track.positions)
                for name, stack in self.named().items()
            }
        )


@dataclass(frozen=True)
class EntityMasks:
    """The final masks: of the person, of the object, and of pixels that show no scene."""

    human: MaskStack
    object: MaskStack
    blank: MaskStack

    def moving(self, frame: int) -> Bool[np.ndarray, "H W"]:
        """Pixels of a frame that show no scene that stands still."""
        return self.human[frame] | self.object[frame] | self.blank[frame]


def entity_masks(
    given: GivenMasks,
    ball: BallTrack | None,
    images: Images,
    silhouettes: Callable[[], MaskStack],
    fitted: Bool[np.ndarray, " F"],
) -> tuple[MaskStack, MaskStack, str]:
    """Masks of person and object, disjoint, and what they were made from.

    Args:
        images: gives the undistorted frames anew on every call.
        silhouettes: gives the fitted body's; called only if masks must be separated.
        fitted: frames whose body was fitted to landmarks.
    """
    if given.human is not None and given.object is not None:
        human = MaskStack(h & ~o for h, o in zip(given.human, given.object, strict=True))
        return human, given.object, "given for each entity; the object's win where they overlap"
    together = given.together or given.human
    assert together is not None  # EstimateReader requires one or the other
    if ball is not None:
        human, objects = _disc_masks(together, ball)
        return human, objects, "ball: its disc; person: the given mask without the disc"
    human, objects = separate(images, together, silhouettes(), fitted)
    text = (
        "one given mask of person and object, separated by the fitted body's silhouette, "
        "colour and neighbouring frames: borders between them are weak, more so where the body "
        "fit is off"
    )
    return human, objects, text


def _disc_masks(together: MaskStack, ball: BallTrack) -> tuple[MaskStack, MaskStack]:
    human, objects = MaskStack(), MaskStack()
    for i, mask in enumerate(together):
        disc = ball.disc(i, mask.shape[1], mask.shape[0])
        seen = bool(ball.observed[i])
        # an unseen ball is still no person, and the interpolated disc only roughly where it is
        person = mask & ~(disc if seen else ndimage.binary_dilation(disc, iterations=3))
        human.append(largest_parts(person, smallest=0.01))
        objects.append(disc if seen else np.zeros_like(disc))
    return human, objects
