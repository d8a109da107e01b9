"""The final masks of a clip: everybody and every object without common pixels, and blank ones."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from scipy import ndimage

from hoigs.preparation.cameras.camera_track import CameraTrack
from hoigs.preparation.estimates.reader import FoundObject, GivenMasks
from hoigs.preparation.mask_stack import FrameFile, Images, MaskStack, largest_parts
from hoigs.preparation.objects.ball import BallTrack
from hoigs.preparation.video.pictures import shrink, shrink_mask

# Pixels that hold no picture: painted over, outside a stabilised frame, letterbox bars.
#
# They are not part of the scene, and they differ from frame to frame, so a static scene would
# otherwise be trained and scored on pixels that no camera saw.

BLACK = 2  # of 255: a lens and a codec never leave a real surface this dark and this flat
NEARLY_BLACK = 16  # the codec's ringing at the border of what was painted
SMALLEST = 5e-4  # of the image
BORDER = 2  # pixels that the border mixes
ALWAYS = 0.9  # of the frames: what people hide in more of them shows nothing else


def blank_pixels(
    image: UInt8[np.ndarray, "H W 3"], moving: Bool[np.ndarray, "H W"]
) -> Bool[np.ndarray, "H W"]:
    """Flat black patches outside the masks of what moves (black shoes are no blank)."""
    darkness = image.max(-1)
    black = ndimage.binary_opening((darkness <= BLACK) & ~moving, iterations=1)
    labels, count = ndimage.label(black)
    if count == 0:
        return np.zeros_like(black)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    patches = (sizes >= max(16, SMALLEST * black.size))[labels]
    around = (darkness <= NEARLY_BLACK) & ~moving
    grown = ndimage.binary_propagation(patches, mask=around | patches)
    return ndimage.binary_dilation(grown, iterations=BORDER) & ~moving if grown.any() else grown


BINS = 24  # a colour channel
WORK_SIDE = 480  # pixels; masks need no more to be separated, and time grows with area
GUESSED = 0.2  # weight of a silhouette in a frame whose body was not seen
CRUMB = 0.05  # of the person's largest part
STRAY = 0.15  # of the longer side: parts farther than this from the object are not of it
MARGIN = 0.03  # of the image's longer side: how far clothes reach beyond the body


def separate(
    images: Images,
    together: MaskStack,
    bodies: MaskStack,
    fitted: Bool[np.ndarray, " F"],
    rounds: int = 4,
    folder: Path | None = None,
) -> tuple[MaskStack, MaskStack]:
    """The person's and the object's masks, which divide `together`.

    Every pixel has a log-odds of being the object: from its distance to the body's silhouette
    (soft, because clothes reach beyond it and fits are off), from the two colour histograms that
    the masks of the round before give over all frames, from the object's place in the frames
    before and after, and from its neighbours (a mean field with a box neighbourhood). It is
    GrabCut's idea (Rother et al. 2004) with histograms in place of mixtures and a mean field in
    place of the cut. Large frames are worked on at a longer side of 480 pixels. One frame's pixels
    are in memory at a time; small pictures and log-odds lie in files that are gone afterwards.

    Args:
        images: gives the frames anew on every call.
        together: person and object. bodies: silhouettes of the fitted body, unclothed.
        fitted: frames whose body was fitted to something seen; silhouettes of the others are
            guesses: they count less, and colours are not learnt from them.
        rounds: of colours and masks, after the first masks from the silhouettes alone.
        folder: of those files; None: the system's temporary folder.

    Returns:
        human, object
    """
    # width and height to work at
    shape = together[0].shape
    factor = min(1.0, WORK_SIDE / max(shape))
    size = max(1, round(shape[1] * factor)), max(1, round(shape[0] * factor))
    wholes = MaskStack(shrink_mask(m, *size) for m in together)
    pictures = FrameFile(folder, (shrink(image, *size) for image in images()))
    small_bodies = MaskStack(shrink_mask(b, *size) for b in bodies)
    trust = [
        _trust(b, t) * (1.0 if seen else GUESSED)
        for b, t, seen in zip(small_bodies, wholes, fitted, strict=True)
    ]
    odds = FrameFile(
        folder,
        (w * _silhouette_odds(b) for b, w in zip(small_bodies, trust, strict=True)),
    )
    objects = MaskStack(t & (o > 0) for t, o in zip(wholes, odds, strict=True))
    for turn in range(rounds):
        colors = _learned(pictures, wholes, objects, odds, trust)
        found = MaskStack()
        for i, mask in enumerate(wholes):
            color = colors(pictures[i])
            place = _place(objects, i) if turn else 0.0
            found.append(_object_parts(_mean_field(odds[i] + color + place, mask), color))
        objects = MaskStack(_without_strays(found))
    humans, separated = MaskStack(), MaskStack()
    for mask, part, whole in zip(together, _adopted(objects, wholes), wholes, strict=True):
        object_mask = mask & _enlarged(part, whole & ~part, mask.shape)
        humans.append(mask & ~object_mask)
        separated.append(object_mask)
    return humans, separated


def _enlarged(
    object_mask: Bool[np.ndarray, "h w"], human: Bool[np.ndarray, "h w"], shape: tuple[int, ...]
) -> Bool[np.ndarray, "H W"]:
    """Where, at the full size, the object is nearer than the person."""
    if object_mask.shape == shape:
        return object_mask
    nearer = ndimage.gaussian_filter(object_mask.astype(np.float32) - human, 1.0)
    large = Image.fromarray(nearer).resize((shape[1], shape[0]), Image.Resampling.BILINEAR)
    return np.asarray(large) > 0


def _learned(
    pictures: FrameFile,
    wholes: MaskStack,
    objects: MaskStack,
    odds: FrameFile,
    trust: Sequence[float],
) -> ColorOdds:
    """Colours of both, from the frames whose silhouette is to be trusted."""
    colors = ColorOdds()
    for image, mask, part, odd, w in zip(pictures, wholes, objects, odds, trust, strict=True):
        if w > 0.5 * max(trust):
            # pixels on the silhouette's border are ambiguous
            sure = mask & (np.abs(odd) > 0.5 * w)
            colors.learn(image, sure & part, sure & ~part)
    colors.settle()
    return colors


def _trust(body: Bool[np.ndarray, "H W"], together: Bool[np.ndarray, "H W"]) -> float:
    """0.2..1: how much of a silhouette lies on the mask that it ought to lie on."""
    inside = (body & together).sum() / max(1, body.sum())
    return float(np.clip((inside - 0.6) / 0.3, 0.2, 1.0))


def _silhouette_odds(body: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """Log-odds of the object from the signed distance to a silhouette: -2 inside, 2 far off."""
    if not body.any():
        return np.zeros(body.shape, np.float32)
    scale = MARGIN * max(body.shape)
    outside = ndimage.distance_transform_edt(~body)
    inside = ndimage.distance_transform_edt(body)
    return (2 * np.tanh((outside - inside - scale) / scale)).astype(np.float32)


def _place(objects: MaskStack, frame: int) -> Float[np.ndarray, "H W"]:
    """Log-odds -1..1 from where the object is in the two frames before and after."""
    near = [objects[i] for i in range(frame - 2, frame + 3) if 0 <= i < len(objects) and i != frame]
    if not near:
        return np.zeros(objects[frame].shape, np.float32)
    mean = np.mean(near, axis=0, dtype=np.float32)
    return 2 * ndimage.uniform_filter(mean, int(MARGIN * max(mean.shape)) | 1) - 1


class ColorOdds:
    """Log-odds of object against person by colour, from histograms over all frames."""

    def __init__(self) -> None:
        self._counts = np.zeros((2, BINS, BINS, BINS))
        self._odds = np.zeros((BINS, BINS, BINS), np.float32)

    def learn(
        self,
        image: UInt8[np.ndarray, "H W 3"],
        object_mask: Bool[np.ndarray, "H W"],
        human_mask: Bool[np.ndarray, "H W"],
    ) -> None:
        for i, mask in enumerate((object_mask, human_mask)):
            cells = _bins(image[mask]) @ np.array([BINS * BINS, BINS, 1])
            self._counts[i] += np.bincount(cells, minlength=BINS**3).reshape(self._counts[i].shape)

    def settle(self) -> None:
        """Smooths the histograms and takes their ratio; colours never seen have odds of 0."""
        totals = self._counts.sum((1, 2, 3))
        if (totals == 0).any():
            return
        smooth = np.stack([ndimage.gaussian_filter(c, 1.0) for c in self._counts])
        likelihood = smooth / totals[:, None, None, None]
        floor = 0.3 / BINS**3
        ratio = np.log(likelihood[0] + floor) - np.log(likelihood[1] + floor)
        self._odds = np.clip(ratio, -4, 4).astype(np.float32)

    def __call__(self, image: UInt8[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W"]:
        index = _bins(image)
        return self._odds[index[..., 0], index[..., 1], index[..., 2]]


def _bins(pixels: UInt8[np.ndarray, "*batch 3"]) -> np.ndarray:
    return pixels.astype(np.int64) * BINS // 256


def _object_parts(
    mask: Bool[np.ndarray, "H W"], color: Float[np.ndarray, "H W"], smallest: float = 0.1
) -> Bool[np.ndarray, "H W"]:
    """The parts whose colours are the object's on average, without crumbs.

    A shoulder that the fitted body misses is as far from the silhouette as a bag, but has the
    person's colours.
    """
    labels, count = ndimage.label(mask)
    if not count:
        return mask
    index = np.arange(1, count + 1)
    like = ndimage.mean(color, labels, index) > 0
    sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:] * like
    keep = like & (sizes >= smallest * sizes.max())
    return np.concatenate(([False], keep))[labels]


def _adopted(
    objects: Iterable[Bool[np.ndarray, "H W"]], wholes: Iterable[Bool[np.ndarray, "H W"]]
) -> Iterator[Bool[np.ndarray, "H W"]]:
    """Objects with the crumbs of the person that touch them and nothing else of the person: a dark
    edge, a buckle."""
    for object_mask, whole in zip(objects, wholes, strict=True):
        labels, count = ndimage.label(whole & ~object_mask)
        sizes = np.bincount(labels.ravel(), minlength=count + 1)
        sizes[0] = 0
        touching = np.unique(labels[ndimage.binary_dilation(object_mask)])
        crumbs = [n for n in touching.tolist() if n and sizes[n] < CRUMB * sizes.max()]
        yield object_mask | np.isin(labels, crumbs)


def _without_strays(
    objects: Sequence[Bool[np.ndarray, "H W"]] | MaskStack, reach: int = 6
) -> Iterator[Bool[np.ndarray, "H W"]]:
    """Drops parts that are far from where the object is in the frames around.

    Where it is: the median, over `reach` frames before and after, of the largest part's middle.
    Far: no pixel within STRAY of it.
    """
    middles = np.full((len(objects), 2), np.nan)
    for i, mask in enumerate(objects):
        labels, count = ndimage.label(mask)
        if count:
            largest = 1 + np.bincount(labels.ravel())[1:].argmax()
            middles[i] = np.argwhere(labels == largest).mean(0)
    for i, mask in enumerate(objects):
        around = middles[max(0, i - reach) : i + reach + 1]
        around = around[np.isfinite(around[:, 0])]
        labels, count = ndimage.label(mask)  # again: kept of all frames they would fill memory
        if not count or not len(around):
            yield mask
            continue
        middle = np.median(around, axis=0)
        rows, columns = np.nonzero(labels)
        away = np.hypot(rows - middle[0], columns - middle[1])
        numbers = labels[rows, columns]
        near = np.unique(numbers[away <= STRAY * max(labels.shape)])
        yield np.isin(labels, near) & (labels > 0)


def _mean_field(
    odds: Float[np.ndarray, "H W"],
    mask: Bool[np.ndarray, "H W"],
    reach: float = 0.02,
    weight: float = 4.0,
    steps: int = 8,
) -> Bool[np.ndarray, "H W"]:
    """Object pixels of `mask` after neighbours have agreed; reach in parts of the longer side."""
    size = max(3, int(reach * max(mask.shape)) | 1)
    inside = mask.astype(np.float32)
    norm = np.maximum(ndimage.uniform_filter(inside, size), 1e-3)
    belief = np.tanh(odds / 2) * inside
    for _ in range(steps):
        neighbours = ndimage.uniform_filter(belief, size) / norm
        belief = np.tanh((odds + weight * neighbours) / 2) * inside
    return mask & (belief > 0)


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


@dataclass(frozen=True)
class MaskSources:
    """What the masks of the first person and object are made from.

    Attributes:
        ball: the object, if it was tracked as one.
        images: gives the undistorted frames anew on every call.
        silhouettes: gives the fitted body's; called only if masks must be separated.
        fitted: frames whose body was fitted to landmarks.
        folder: for temporary files; None: the system's.
    """

    given: GivenMasks
    ball: BallTrack | None
    images: Images
    silhouettes: Callable[[], MaskStack]
    fitted: Bool[np.ndarray, " F"]
    folder: Path | None = None


def entity_masks(sources: MaskSources) -> tuple[MaskStack, MaskStack, str]:
    """Masks of person and object, disjoint, and what they were made from."""
    given, ball = sources.given, sources.ball
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
    human, objects = separate(
        sources.images, together, sources.silhouettes(), sources.fitted, folder=sources.folder
    )
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
    sources: MaskSources,
    others: Mapping[str, MaskStack],
    found: FoundObject | None,
    track: CameraTrack,
    *,
    keep_black: bool,
) -> tuple[EntityMasks, str]:
    """The masks, and what they were made from.

    Args:
        others: of further people.
        found: objects that were followed in the video, the first and further ones.
        track: cameras; pixels that their lens does not show are blank.
        keep_black: take flat black patches for a part of the scene.
    """
    human, object_masks, text = entity_masks(sources)
    further: dict[str, MaskStack] = {}
    if found is not None:
        text = f"{text}: {found.provenance}"
        if found.further:
            human, object_masks, further = _further(human, object_masks, found, track)
    things = [object_masks, *further.values()]
    people = without_others(others, human, things)
    shown, beside = [human, *people.values(), *things], sources.given.beside
    known = shown if beside is None else [*shown, beside]
    blank = _nothing(human) if keep_black else _blank(sources.images, known)
    if (outside := track.undistort.outside) is not None:
        blank = MaskStack(mask | outside for mask in blank)
    if beside is not None:
        blank = _with_people(blank, beside, shown, still=track.static)
    return EntityMasks(human, object_masks, blank, further, people), text


def _with_people(
    blank: MaskStack, beside: MaskStack, shown: Sequence[MaskStack], *, still: bool
) -> MaskStack:
    """Blank pixels, and those of people who are not fitted: but, before a still camera, what they
    hide in nearly all frames is the scene there, as nothing else is seen of it."""
    often = np.zeros(beside[0].shape, np.int32)
    for mask in beside if still else ():
        often += mask
    always = often > ALWAYS * len(beside)
    return MaskStack(
        mask | (other & ~always & ~np.logical_or.reduce(rows))
        for mask, other, *rows in zip(blank, beside, *shown, strict=True)
    )


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


def blank_warning(
    blank: MaskStack, outside: Bool[np.ndarray, "H W"] | None, beside: MaskStack | None = None
) -> list[str]:
    """A sentence, if any pixel is blank that is not `outside` of what the lens shows, and not of
    people `beside` those who are fitted."""
    patches = blank if outside is None else MaskStack(mask & ~outside for mask in blank)
    if beside is not None:
        patches = MaskStack(mask & ~other for mask, other in zip(patches, beside, strict=True))
    coverage = patches.coverage()
    if not coverage.any():
        return []
    return [
        f"{int((coverage > 0).sum())} frames have flat black patches, up to "
        f"{100 * coverage.max():.1f} % of the image, which show no scene: they are left "
        "out of training and scores (--keep-black if they are real)"
    ]
