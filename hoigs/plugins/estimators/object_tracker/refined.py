"""Masks of a followed object, outlined again by the network, and in frames between them."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from hoigs.plugins.estimators.object_tracker.footage import Footage
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
    progress: Callable[[float], None] = lambda share: None,
) -> Refined:
    """The same object with masks that the network outlines, in more frames.

    Args:
        clicked: frames in which it is known.
    """
    found = _outlined(footage, outlines, track, lambda share: progress(0.8 * share))
    better = _sharpened(footage, track, found)
    better, more = _bridged(footage, outlines, better, lambda share: progress(0.8 + 0.2 * share))
    return Refined(better, _led({**found, **more}, clicked, len(footage)))


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


def _led(found: Outlined, clicked: Collection[int], count: int) -> Bool[np.ndarray, " F"]:
    led = np.zeros(count, bool)
    for start in clicked:
        for step in (1, -1):
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
    if not (mask.any() and other.any()):
        return False
    away = np.array(center_of(mask)) - center_of(other)
    dx, dy = np.rint(away).astype(int).tolist()
    return overlap(mask, np.roll(other, (dy, dx), (0, 1))) >= STEADY


def again(
    footage: Footage, outlines: Outlines, i: int, mask: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w"] | None:
    """A soft mask by the network's outline in the box about a mask; None where it is of something
    else, or not sure."""
    x0, y0, x1, y1 = box_of(mask)
    room = ROOM * max(x1 - x0, y1 - y0)
    outlines.look(footage.numbers[i], around((x0, y0, x1, y1), footage.shape))
    found = outlines.found([(x0 - room, y0 - room), (x1 + room, y1 + room)], [LOW, HIGH])[0]
    kept = _kept(found, mask) & ~footage.blank[i]
    if found.quality < SURE or overlap(kept, mask) < SAME:
        return None
    near = ndimage.binary_dilation(kept, iterations=2)
    return np.where(near, found.soft, np.float32(0))


def _kept(found: Outline, mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The parts of an outline that a mask meets."""
    labels, _ = ndimage.label(found.mask)
    return np.isin(labels, np.setdiff1d(np.unique(labels[mask]), 0))
