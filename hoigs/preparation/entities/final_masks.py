"""The final masks of a clip: everybody and every object without common pixels, and blank ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from hoigs.preparation.cameras.camera_track import CameraTrack
from hoigs.preparation.entities.entity_masks import (
    EntityMasks,
    disjoint,
    entity_masks,
    without_others,
)
from hoigs.preparation.entities.person import FittedPeople
from hoigs.preparation.estimates.given import GivenMasks
from hoigs.preparation.estimates.reader import FoundObject, UndistortedEstimates
from hoigs.preparation.masks.mask_stack import MaskStack
from hoigs.preparation.masks.separate import Images
from hoigs.preparation.video.blank import blank_pixels


def final_masks(
    given: GivenMasks,
    estimates: UndistortedEstimates,
    people: FittedPeople,
    found: FoundObject | None,
    track: CameraTrack,
    images: Images,
    silhouettes: Callable[[], MaskStack],
    *,
    keep_black: bool,
    folder: Path,
) -> tuple[EntityMasks, str]:
    """The masks, and what they were made from.

    Args:
        given: of the first person and object. estimates: with those of further people.
        found: objects that were followed in the video, the first and further ones.
        images: gives the undistorted frames anew on every call.
        silhouettes: gives the fitted body's; called only if masks must be separated.
        keep_black: take flat black patches for a part of the scene.
        folder: for temporary files.
    """
    first = people.first
    fitted = np.zeros(len(track.positions), bool) if first is None else first.found
    human, object_masks, text = entity_masks(
        given, estimates.ball, images, silhouettes, fitted, folder
    )
    further: dict[str, MaskStack] = {}
    if found is not None:
        text = f"{text}: {found.provenance}"
        if found.further:
            human, object_masks, further = _further(human, object_masks, found, track)
    things = [object_masks, *further.values()]
    masks = {name: person.masks for name, person in estimates.further.items()}
    others = without_others(masks, human, things)
    shown = [human, *others.values(), *things]
    blank = _nothing(human) if keep_black else _blank(images, shown)
    return EntityMasks(human, object_masks, blank, further, others), text


def _further(
    human: MaskStack, first: MaskStack, found: FoundObject, track: CameraTrack
) -> tuple[MaskStack, MaskStack, dict[str, MaskStack]]:
    """The masks of person and objects without common pixels; the objects' win."""
    undistort, rows = track.undistort, list(track.positions)
    stacks = [
        MaskStack(undistort.mask(other.masks[i]) for i in rows) for other in found.further.values()
    ]
    sure = [
        None if other.confidence is None else other.confidence[rows]
        for other in (found, *found.further.values())
    ]
    first, *stacks = disjoint([first, *stacks], sure)
    human = MaskStack(
        person & ~np.logical_or.reduce(held) for person, *held in zip(human, *stacks, strict=True)
    )
    return human, first, dict(zip(found.further, stacks, strict=True))


def _nothing(masks: MaskStack) -> MaskStack:
    return MaskStack(np.zeros_like(mask) for mask in masks)


def _blank(images: Images, entities: Sequence[MaskStack]) -> MaskStack:
    """Pixels that show neither the scene nor an entity."""
    return MaskStack(
        blank_pixels(image, np.logical_or.reduce(shown))
        for image, *shown in zip(images(), *entities, strict=True)
    )


def blank_warning(blank: MaskStack) -> list[str]:
    """A sentence, if any pixel is blank."""
    coverage = blank.coverage()
    if not coverage.any():
        return []
    return [
        f"{int((coverage > 0).sum())} frames have flat black patches, up to "
        f"{100 * coverage.max():.1f} % of the image, which show no scene: they are left "
        "out of training and scores (--keep-black if they are real)"
    ]
