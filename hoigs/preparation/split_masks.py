"""The person's and the object's masks, from whatever masks the source has."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import ndimage

from hoigs.preparation.ball import BallTrack
from hoigs.preparation.cameras import Undistortion
from hoigs.preparation.frames import VideoFrames
from hoigs.preparation.masks import MaskStack, load_masks
from hoigs.preparation.separate import Images, separate
from hoigs.preparation.source import Source


def entity_masks(
    source: Source,
    video: VideoFrames,
    undistort: Undistortion,
    ball: BallTrack | None,
    images: Images,
    silhouettes: Callable[[], MaskStack],
    names: tuple[str, str],
) -> tuple[MaskStack, MaskStack, str]:
    """Masks of person and object, disjoint, and what they were made from.

    Args:
        images: gives the undistorted frames anew on every call.
        silhouettes: gives the fitted body's; called only if masks must be taken apart.
        names: of the human and object entities.
    """
    human_name, object_name = names
    if set(source.apart) == {human_name, object_name}:
        human = load_masks(source.apart[human_name], video, undistort)
        things = load_masks(source.apart[object_name], video, undistort)
        human = MaskStack(h & ~o for h, o in zip(human, things, strict=True))
        return human, things, "given for each entity; the object's win where they overlap"
    folder = source.together or source.apart[human_name]
    together = load_masks(folder, video, undistort)
    if ball is not None:
        human, things = _disc_masks(together, ball)
        return human, things, "ball: its disc; person: the given mask without the disc"
    human, things = separate(images, together, silhouettes())
    text = (
        "one given mask of person and object, taken apart by the fitted body's silhouette, "
        "colour and neighbouring frames: borders between them are weak, more so where the body "
        "fit is off"
    )
    return human, things, text


def _disc_masks(together: MaskStack, ball: BallTrack) -> tuple[MaskStack, MaskStack]:
    human, things = MaskStack(), MaskStack()
    for i, mask in enumerate(together):
        disc = ball.disc(i, mask.shape[1], mask.shape[0])
        seen = bool(ball.observed[i])
        # an unseen ball is still no person, and the interpolated disc only roughly where it is
        human.append(mask & ~(disc if seen else ndimage.binary_dilation(disc, iterations=3)))
        things.append(disc if seen else np.zeros_like(disc))
    return human, things
