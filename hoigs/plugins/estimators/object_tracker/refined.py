"""Masks of a followed object, outlined again by the network, and in frames between them."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from hoigs.plugins.estimators.object_tracker.footage import Footage, bins_of, histogram
from hoigs.plugins.estimators.object_tracker.motion import moved_on
from hoigs.plugins.estimators.object_tracker.outlined import SAME, around, box_of, sharper
from hoigs.plugins.estimators.object_tracker.outlines import HIGH, LOW, Outline, Outlines
from hoigs.plugins.estimators.object_tracker.path import center_of
from hoigs.plugins.estimators.object_tracker.prompts import overlap
from hoigs.plugins.estimators.object_tracker.propagation import Track

SURE = 0.7  # the network's own estimate from which an outline counts
ROOM = 0.03  # of the longer side of the box about a mask, which may lack a rim


@dataclass(frozen=True)
class Refined:
    """An object with masks of the network.

    Attributes:
        led: frames to which its outlines lead from a clicked frame, without a jump from one frame
            to the next: what they show is what was clicked, whatever colours it has.
    """

    track: Track
    led: Bool[np.ndarray, " F"]


def refined(
    footage: Footage,
    outlines: Outlines,
    track: Track,
    clicked: Collection[int],
    has_rivals: bool = False,
    progress: Callable[[float], None] = lambda share: None,
) -> Refined:
    """The same object with masks that the network outlines, in more frames.

    Args:
        clicked: frames in which it is known. has_rivals: other things look the same, so that no
            further frame is taken to show it.
    """
    found = _outlined(footage, outlines, track, lambda share: progress(0.7 * share))
    better = _sharpened(footage, track, found)
    if has_rivals:
        return Refined(better, _led(found, clicked, len(footage)))
    better, other = _steadied(footage, outlines, better)
    better, more = _bridged(footage, outlines, better, lambda share: progress(0.7 + 0.1 * share))
    led = _led(found | other | more, clicked, len(footage))
    return _carried_on(footage, outlines, better, led, lambda share: progress(0.8 + 0.2 * share))


Outlined = dict[int, Float[np.ndarray, "h w"]]  # soft masks of the network by frame


def _outlined(
    footage: Footage, outlines: Outlines, track: Track, progress: Callable[[float], None]
) -> Outlined:
    """Outlines of the frames in which the network sees one thing in the box about a mask that is
    about this mask."""
    shown, found = np.flatnonzero((track.soft > 127).any((1, 2))).tolist(), {}
    for done, i in enumerate(shown):
        outline = again(footage, outlines, i, track.soft[i] > 127)
        if outline is not None:
            found[i] = outline
        progress((done + 1) / len(shown))
    return found


def _sharpened(footage: Footage, track: Track, found: Outlined) -> Track:
    """A track with these masks, or as it was, if they are less well set off over the video."""
    masks = {i: track.soft[i] > 127 for i in found}
    if not found or not sharper(footage, masks, {i: soft > 0.5 for i, soft in found.items()}):
        return track
    soft = track.soft.copy()
    for i, better in found.items():
        soft[i] = np.rint(255 * better)
    return Track(soft, track.confidence)


STEADY = 0.7  # overlap of a thing's outlines in one frame and the next, about their middles
ODD = 0.05  # by how much more the masks beside one overlap each other than it, which is odd then


def _steadied(footage: Footage, outlines: Outlines, track: Track) -> tuple[Track, Outlined]:
    """The same object with an outline like those of the two frames beside it, where these show the
    same shape and its mask is another; and these outlines. A clicked frame may be such: it is the
    one that nothing else explains."""
    masks, soft = track.soft > 127, track.soft.copy()
    found: Outlined = {}
    shown, last = masks.any((1, 2)), len(masks) - 1
    for i in np.flatnonzero(shown).tolist() if last > 1 else ():
        a, b = (i - 1, i + 1) if 0 < i < last else (1, 2) if i == 0 else (last - 1, last - 2)
        alike = _alike(masks[i], masks[a])
        if _alike(masks[a], masks[b]) < max(STEADY, alike + ODD):
            continue
        outline = again(footage, outlines, i, masks[a])
        if outline is not None and _alike(outline > 0.5, masks[a]) > max(STEADY, alike):
            soft[i], found[i] = np.rint(255 * outline), outline
    return Track(soft, track.confidence), found


LONGEST = 60  # frames without a mask that outlines may lead through


def _bridged(
    footage: Footage, outlines: Outlines, track: Track, progress: Callable[[float], None]
) -> tuple[Track, Outlined]:
    """The same object in frames between two that show it, too, where the network's outlines lead
    without a jump from its mask in the one to that in the other; and these outlines."""
    soft, confidence = track.soft.copy(), track.confidence.copy()
    shown = np.flatnonzero((track.soft > 127).any((1, 2))).tolist()
    found: Outlined = {}
    gaps = [(a, b) for a, b in pairwise(shown) if 1 < b - a <= LONGEST]
    for done, (a, b) in enumerate(gaps):
        last, way = track.soft[a] > 127, []
        for i in range(a + 1, b):
            outline = again(footage, outlines, i, last)
            if outline is None or not _steady(outline > 0.5, last):
                break
            way.append(outline)
            last = outline > 0.5
        if len(way) == b - a - 1 and _steady(last, track.soft[b] > 127):
            soft[a + 1 : b] = np.rint(255 * np.stack(way))
            confidence[a + 1 : b] = min(confidence[a], confidence[b])
            found |= dict(zip(range(a + 1, b), way, strict=True))
        progress((done + 1) / len(gaps))
    return Track(soft, confidence), found


# Of an outline in a frame without a mask: the network's own estimate, the share of it that is where
# the object went, their overlap, and the likeness of its colours and those of the object.
SURER, WITHIN, LEFT, LIKE = 0.85, 0.8, 0.35, 0.6
# Overlap from which no hand need hide the rest, and share of the object that an outline and people
# explain together.
OPEN, EXPLAINED = 0.75, 0.8
WHOLE = 0.88  # ratio of areas from which an outline shows all of the object


def _carried_on(
    footage: Footage,
    outlines: Outlines,
    track: Track,
    led: Bool[np.ndarray, " F"],
    progress: Callable[[float], None],
) -> Refined:
    """The same object in frames next to those to which outlines lead from a click, too, as far as
    outlines are where its motion carries it, such as the part of it that a hand leaves free."""
    soft, confidence = track.soft.copy(), track.confidence.copy()
    certain, starts = led.copy(), np.flatnonzero(led).tolist()
    if not starts:
        return Refined(track, led)
    usual = np.sqrt(np.mean([_colors(footage, i, soft[i] > 127) for i in starts], axis=0))
    for done, (start, step) in enumerate(product(starts, (1, -1))):
        i, whole = start, soft[start] > 127
        while 0 <= i + step < len(footage) and not (soft[i + step] > 127).any():
            whole = _gone_with(footage, i, i + step, soft[i] > 127, whole)
            i += step
            outline = _left_of(footage, outlines, i, whole, usual) if whole.any() else None
            if outline is None:
                break
            soft[i], confidence[i], certain[i] = np.rint(255 * outline), confidence[i - step], True
            if WHOLE < (outline > 0.5).sum() / whole.sum() < 1 / WHOLE:
                whole = outline > 0.5
        progress((done + 1) / (2 * len(starts)))
    return Refined(Track(soft, confidence), certain)


def _gone_with(
    footage: Footage,
    i: int,
    j: int,
    seen: Bool[np.ndarray, "h w"],
    whole: Bool[np.ndarray, "h w"],
) -> Bool[np.ndarray, "h w"]:
    """The mask of a whole object of frame `i` in frame `j`: moved with its pixels if all of it is
    seen in both, else shifted as what is seen of it moves."""
    moved, *_ = moved_on(footage, i, j, seen)
    if not moved.any() or moved.sum() > WHOLE * whole.sum():
        return moved
    x, y = np.array(center_of(moved)) - center_of(seen)
    return ndimage.shift(whole.astype(np.uint8), (round(float(y)), round(float(x))), order=0) > 0


def _left_of(
    footage: Footage,
    outlines: Outlines,
    i: int,
    whole: Bool[np.ndarray, "h w"],
    usual: Float[np.ndarray, " B"],
) -> Float[np.ndarray, "h w"] | None:
    """Of what the network may see in the box about an object, the soft mask that is most of it and
    nothing else; None where there is none, or no person hides the rest of the object.

    Args:
        usual: roots of the histogram of the object's colours.
    """
    best, most = None, 0.0
    for outline in _in_box(footage, outlines, i, whole):
        mask = _kept(outline, whole) & ~footage.blank[i]
        share, within = overlap(mask, whole), (mask & whole).sum() / max(mask.sum(), 1)
        if outline.quality < SURER or share < LEFT or within < WITHIN:
            continue
        if share < OPEN and (whole & (mask | footage.person[i])).sum() < EXPLAINED * whole.sum():
            continue
        alike = np.sqrt(_colors(footage, i, mask)) @ usual
        if outline.quality + share > most and alike > LIKE:
            best, most = np.where(mask, outline.soft, np.float32(0)), outline.quality + share
    return best


def _in_box(
    footage: Footage, outlines: Outlines, i: int, mask: Bool[np.ndarray, "h w"]
) -> list[Outline]:
    """What the network may see in the box about a mask: its own choice, then a part, a whole and a
    group."""
    x0, y0, x1, y1 = box_of(mask)
    room = ROOM * max(x1 - x0, y1 - y0)
    outlines.look(footage.numbers[i], around((x0, y0, x1, y1), footage.shape))
    return outlines.found([(x0 - room, y0 - room), (x1 + room, y1 + room)], [LOW, HIGH])


def _colors(footage: Footage, i: int, mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, " B"]:
    """Histogram of a mask's colours."""
    return histogram(bins_of(footage.colors(i)), mask * 1.0)


def _led(found: Outlined, clicked: Collection[int], count: int) -> Bool[np.ndarray, " F"]:
    """Frames to which outlines lead from a clicked one, each like the one before."""
    led = np.zeros(count, bool)
    for start, step in product(clicked, (1, -1)):
        i = start
        while i in found:
            led[i] = True
            there = found.get(i + step)
            if there is None or not _steady(found[i] > 0.5, there > 0.5):
                break
            i += step
    return led


def _steady(mask: Bool[np.ndarray, "h w"], other: Bool[np.ndarray, "h w"]) -> bool:
    """Whether two masks are of one shape, wherever they are."""
    return _alike(mask, other) >= STEADY


def _alike(mask: Bool[np.ndarray, "h w"], other: Bool[np.ndarray, "h w"]) -> float:
    """Overlap of two masks about their middles; 0 where one is empty."""
    if not (mask.any() and other.any()):
        return 0.0
    away = np.array(center_of(mask)) - center_of(other)
    dx, dy = np.rint(away).astype(int).tolist()
    return overlap(mask, np.roll(other, (dy, dx), (0, 1)))


def again(
    footage: Footage, outlines: Outlines, i: int, mask: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w"] | None:
    """A soft mask by the network's outline in the box about a mask; None where it is of something
    else, or not sure."""
    found = _in_box(footage, outlines, i, mask)[0]
    kept = _kept(found, mask) & ~footage.blank[i]
    if found.quality < SURE or overlap(kept, mask) < SAME:
        return None
    near = ndimage.binary_dilation(kept, iterations=2)
    return np.where(near, found.soft, np.float32(0))


def _kept(found: Outline, mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The parts of an outline that a mask meets."""
    labels, _ = ndimage.label(found.mask)
    return np.isin(labels, np.setdiff1d(np.unique(labels[mask]), 0))
