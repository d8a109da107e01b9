"""The final masks of a clip: everybody and every object without common pixels, and blank ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from hoigs.preparation.cameras.camera_track import CameraTrack
from hoigs.preparation.choose_frames import blank_pixels
from hoigs.preparation.estimates.given import FoundObject, GivenMasks
from hoigs.preparation.masks.mask_stack import MaskStack, largest_parts
from hoigs.preparation.masks.separate import Images, separate
from hoigs.preparation.objects.ball import BallTrack

# The person's and the object's masks, from whatever masks the source has.


@dataclass(frozen=True)
class EntityMasks:
    """The final masks: of the person, of the object, of pixels that show no scene, and by name of
    `further` objects and `people`. Without a person or an object, its masks are empty."""

    human: MaskStack
    object: MaskStack
    blank: MaskStack
    further: dict[str, MaskStack] = field(default_factory=dict)
    people: dict[str, MaskStack] = field(default_factory=dict)

    def humans(self) -> MaskStack:
        """Pixels that show anybody."""
        if not self.people:
            return self.human
        stacks = zip(self.human, *self.people.values(), strict=True)
        return MaskStack(np.logical_or.reduce(rows) for rows in stacks)

    def objects(self, frame: int) -> Bool[np.ndarray, "H W"]:
        """Pixels of a frame that show any object."""
        further = (masks[frame] for masks in self.further.values())
        return np.logical_or.reduce([self.object[frame], *further])

    def other_objects(self, name: str | None = None) -> MaskStack:
        """Pixels of all objects but one: that of `further` by name; None: that of `object`."""
        others = [m for n, m in self.further.items() if n != name]
        others += [] if name is None else [self.object]
        nothing = MaskStack(np.zeros_like(mask) for mask in self.human)
        return MaskStack(np.logical_or.reduce(rows) for rows in zip(nothing, *others, strict=True))

    def moving(self, frame: int) -> Bool[np.ndarray, "H W"]:
        """Pixels of a frame that show no scene that stands still."""
        people = [masks[frame] for masks in self.people.values()]
        shown = [self.human[frame], *people, self.objects(frame), self.blank[frame]]
        return np.logical_or.reduce(shown)


def disjoint(
    stacks: Sequence[MaskStack], confidence: Sequence[Float[np.ndarray, " F"] | None]
) -> list[MaskStack]:
    """Masks of several objects without common pixels: the one followed most surely in a frame
    keeps them, of equals the first."""
    found = [MaskStack() for _ in stacks]
    for frame in range(len(stacks[0])):
        sure = [0.0 if c is None else float(np.nan_to_num(c[frame])) for c in confidence]
        taken = np.zeros_like(stacks[0][frame])
        kept = {}
        for k in sorted(range(len(stacks)), key=lambda k: -sure[k]):
            kept[k] = stacks[k][frame] & ~taken
            taken |= kept[k]
        for k, stack in enumerate(found):
            stack.append(kept[k])
    return found


def without_others(
    people: Mapping[str, MaskStack], first: MaskStack, things: Sequence[MaskStack]
) -> dict[str, MaskStack]:
    """Masks of further people without common pixels: objects' win, then those of earlier ones."""
    found: dict[str, MaskStack] = {}
    for name, stack in people.items():
        taken = zip(first, *things, *found.values(), strict=True)
        found[name] = MaskStack(
            mask & ~np.logical_or.reduce(rows) for mask, rows in zip(stack, taken, strict=True)
        )
    return found


def entity_masks(
    given: GivenMasks,
    ball: BallTrack | None,
    images: Images,
    silhouettes: Callable[[], MaskStack],
    fitted: Bool[np.ndarray, " F"],
    folder: Path | None = None,
) -> tuple[MaskStack, MaskStack, str]:
    """Masks of person and object, disjoint, and what they were made from.

    Args:
        images: gives the undistorted frames anew on every call.
        silhouettes: gives the fitted body's; called only if masks must be separated.
        fitted: frames whose body was fitted to landmarks.
        folder: for temporary files; None: the system's.
    """
    if given.human is not None and given.object is not None:
        human = MaskStack(h & ~o for h, o in zip(given.human, given.object, strict=True))
        return human, given.object, "given for each entity; the object's win where they overlap"
    together = given.together or given.human
    assert together is not None  # EstimateReader requires one or the other
    if ball is None and given.together is None:
        return together, MaskStack(np.zeros_like(m) for m in together), "given; there is no object"
    if ball is not None:
        human, objects = _disc_masks(together, ball)
        return human, objects, "ball: its disc; person: the given mask without the disc"
    human, objects = separate(images, together, silhouettes(), fitted, folder=folder)
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


def final_masks(
    given: GivenMasks,
    ball: BallTrack | None,
    others: Mapping[str, MaskStack],
    fitted: Bool[np.ndarray, " F"] | None,
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
        given: of the first person and object. ball: the object, if it was tracked as one.
        others: of further people. fitted: frames whose body was fitted to landmarks; None: nobody.
        found: objects that were followed in the video, the first and further ones.
        images: gives the undistorted frames anew on every call.
        silhouettes: gives the fitted body's; called only if masks must be separated.
        keep_black: take flat black patches for a part of the scene.
        folder: for temporary files.
    """
    fitted = np.zeros(len(track.positions), bool) if fitted is None else fitted
    human, object_masks, text = entity_masks(given, ball, images, silhouettes, fitted, folder)
    further: dict[str, MaskStack] = {}
    if found is not None:
        text = f"{text}: {found.provenance}"
        if found.further:
            human, object_masks, further = _further(human, object_masks, found, track)
    things = [object_masks, *further.values()]
    people = without_others(others, human, things)
    shown = [human, *people.values(), *things]
    blank = _nothing(human) if keep_black else _blank(images, shown)
    return EntityMasks(human, object_masks, blank, further, people), text


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
