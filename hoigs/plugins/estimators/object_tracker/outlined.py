"""The object's mask in a clicked frame, by a network that outlines things.

One look does not tell what a click means: the label on a bottle, the bottle, or the hand with it.
What is there as one thing in nearer and in farther looks alike is rather meant than what is seen in
one of them alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool

from hoigs.core.interfaces.estimator import FramePrompt
from hoigs.plugins.estimators.object_tracker.footage import (
    SEEN,
    ColorModel,
    Footage,
    bins_of,
)
from hoigs.plugins.estimators.object_tracker.motion import Motion
from hoigs.plugins.estimators.object_tracker.outlines import (
    HIGH,
    INSIDE,
    LOW,
    OUTSIDE,
    Box,
    Outline,
    Outlines,
)
from hoigs.plugins.estimators.object_tracker.prompts import (
    Judge,
    PromptedMask,
    Tried,
    looks_like_person,
    of_limbs,
    overlap,
    prompted_mask,
    scaled,
)
from hoigs.plugins.estimators.object_tracker.propagation import contrast
from hoigs.plugins.estimators.object_tracker.scene import Scene

LOOKS = (1.0, 0.4, 0.16)  # sides of what is looked at, in longer sides of the frame
ROOM = 2.0  # sides of a box that is looked at with what is around it
NEAREST = 0.1  # of the frame's longer side: nothing smaller is looked at
FEWEST = 9  # pixels of a mask
SAME = 0.5  # overlap from which two masks are of the same thing
DULLER = 0.02  # by how much less the network's masks may be set off
LEAST = 1.4  # score of a mask from which the network knows what was clicked
SURE = 0.5  # the network's own estimate from which an outline may be one
JOINTS = (13, 14, 15, 16, 25, 26, 27, 28)  # elbows, wrists, knees, ankles
BESIDE = 0.01  # of the diagonal: what is nearer to a click may be on the object
HEAD, HANDS = tuple(range(11)), ((15, 17, 19, 21), (16, 18, 20, 22))  # landmarks
# by how much worse a mask is that has a whole head, that has a whole hand and all colours of limbs,
# and that looks like the person it lies on
OF_HEAD, OF_HAND, OF_PERSON = 0.5, 4.0, 0.5
AS_GROWN = 0.3  # by how much better the mask is that grew by colours and edges


@dataclass(frozen=True)
class _Seen:
    """An outline, and which of the looks shows it; -1: one of its own."""

    look: int
    outline: Outline


def clicked_mask(
    footage: Footage,
    scene: Scene,
    i: int,
    prompt: FramePrompt,
    known: ColorModel | None = None,
    outlines: Outlines | None = None,
) -> PromptedMask:
    """The mask of a prompt: of what the network outlines there, as far as it does; else what grows
    from the prompt by colours and edges.

    Args:
        known: the object's colours in other frames. outlines: None: there is no network.
    """
    grown = prompted_mask(footage, scene, i, prompt, known)
    number, (inside, outside, box) = footage.numbers[i], scaled(prompt, footage)
    asked = box is not None or len(inside)
    if outlines is None or not asked or not all(_shown(footage, i, x, y) for x, y in inside):
        return grown
    points = [*map(tuple, inside), *map(tuple, outside)]
    labels = [INSIDE] * len(inside) + [OUTSIDE] * len(outside)
    seen = []
    if box is None:
        joints = _joints(footage, i, inside) if grown.on_person else []
        seen = _looked(outlines, number, points, labels, joints)
        if (mask := grown.soft > 0.5).any():
            box = box_of(mask)
    if box is not None:
        x0, y0, x1, y1 = (float(v) for v in box)
        outlines.look(number, around((x0, y0, x1, y1), footage.shape))
        corners = [(x0, y0), (x1, y1)]
        seen.append(_Seen(-1, outlines.found([*points, *corners], [*labels, LOW, HIGH])[0]))
    return _best(footage, scene, grown, seen, SURE if prompt.box else LEAST)


def _shown(footage: Footage, i: int, x: float, y: float) -> bool:
    """Whether a point is in the picture, and not on a black border of it."""
    h, w = footage.shape
    return 0 <= x < w and 0 <= y < h and not footage.blank[i, int(y), int(x)]


def _joints(
    footage: Footage, i: int, clicks: Float[np.ndarray, "N 2"]
) -> list[tuple[float, float]]:
    """Joints of limbs that are seen, x, y, and are not next to a click."""
    found = []
    for person in footage.people:
        for x, y, _, visible in person[i, list(JOINTS)].tolist():
            if visible > SEEN and np.hypot(*(clicks - (x, y)).T).min() > BESIDE * footage.diagonal:
                found.append((x, y))
    return found


def _looked(
    outlines: Outlines, number: int, points: Sequence[tuple[float, float]], labels: Sequence[int],
    joints: Sequence[tuple[float, float]],
) -> list[_Seen]:  # fmt: skip
    """Three masks of each look at what is around the clicks: a part, a whole, a group; and these
    without a person's joints."""
    h, w = outlines.shape
    middle = np.mean([p for p, label in zip(points, labels, strict=True) if label == INSIDE], 0)
    spread = max(np.ptp([p[0] for p in points]), np.ptp([p[1] for p in points]))
    found = []
    for k, share in enumerate(LOOKS):
        half = max(share * max(h, w), ROOM * spread) / 2
        box = (middle[0] - half, middle[1] - half, middle[0] + half, middle[1] + half)
        outlines.look(number, None if share == 1 else within(box, (h, w)))
        found += [_Seen(k, outline) for outline in outlines.found(points, labels)[1:]]
        x0, y0, x1, y1 = (0, 0, w, h) if share == 1 else within(box, (h, w))
        off = [(x, y) for x, y in joints if x0 < x < x1 and y0 < y < y1]
        if off:
            without = outlines.found([*points, *off], [*labels, *[OUTSIDE] * len(off)])
            found += [_Seen(k, outline) for outline in without]
    return found


def _best(
    footage: Footage, scene: Scene, grown: PromptedMask, seen: Sequence[_Seen], least: float
) -> PromptedMask:
    """The mask that is best by the network, by the other looks and by the person's colours; the
    grown one where no score is above `least`."""
    i = grown.frame
    masks = [s.outline.mask & ~grown.barred for s in seen]
    judge = Judge(footage, i, scene.difference(i), grown.on_person, None, Motion.of(footage, i))
    best, most = grown, least
    for one, mask in zip(seen, masks, strict=True):
        if mask.sum() < FEWEST or one.outline.quality < SURE:
            continue
        x0, y0, x1, y1 = box_of(mask)
        as_grown = Tried(
            mask.astype(np.float32), contrast(footage, i, mask), max(x1 - x0, y1 - y0) / 2
        )
        (quality,) = judge.quality([as_grown])
        soft = np.where(grown.barred, np.float32(0), one.outline.soft)
        mine = replace(grown, soft=soft, quality=quality)
        score = one.outline.quality + _agreement(one, mask, seen, masks)
        score += AS_GROWN * overlap(mask, grown.soft > 0.5) - _of_people(footage, mine)
        if quality > 0 and score > most:
            best, most = mine, score
    mask, again = grown.soft > 0.5, best.soft > 0.5
    if overlap(mask, again) > SAME and not sharper(footage, {i: mask}, {i: again}):
        return grown
    return best


def sharper(
    footage: Footage,
    masks: Mapping[int, Bool[np.ndarray, "h w"]],
    again: Mapping[int, Bool[np.ndarray, "h w"]],
) -> bool:
    """Whether the network's masks of a thing are as well set off, in the mean over frames, as those
    that follow the pixels. The network leaves out what is thin, such as the handle of a cup, but
    knows an edge between like colours.

    Args:
        masks: by frame, those that follow the pixels. again: the network's, in the same frames.
    """
    gained = [contrast(footage, i, again[i]) - contrast(footage, i, masks[i]) for i in masks]
    return float(np.mean(gained)) > -DULLER


def _agreement(
    one: _Seen, mask: Bool[np.ndarray, "h w"], seen: Sequence[_Seen],
    masks: Sequence[Bool[np.ndarray, "h w"]],
) -> float:  # fmt: skip
    """How far the other looks have the same mask, the sum of the two that have it most."""
    found: dict[int, float] = {}
    for other, its in zip(seen, masks, strict=True):
        if other.look not in (one.look, -1):
            alike = overlap(mask, its) * other.outline.quality
            found[other.look] = max(found.get(other.look, 0.0), alike)
    return sum(sorted(found.values())[-2:])


def _of_people(footage: Footage, found: PromptedMask) -> float:
    """How far a mask is rather a part of a person."""
    i, mask = found.frame, found.soft > 0.5
    limbs = of_limbs(footage, i, mask, bins_of(footage.colors(i)))
    hand = max(_has(footage, i, mask, landmarks) for landmarks in HANDS)
    share = limbs * (1 + OF_HAND * hand) + OF_HEAD * _has(footage, i, mask, HEAD)
    return share + OF_PERSON * looks_like_person(footage, found)


def _has(
    footage: Footage, i: int, mask: Bool[np.ndarray, "h w"], landmarks: Sequence[int]
) -> float:
    """The share of somebody's landmarks that a mask has, of whom it has most."""
    h, w = footage.shape
    shares = [0.0]
    for person in footage.people:
        x, y, _, visible = person[i, list(landmarks)].T
        seen = (visible > SEEN) & (x >= 0) & (x < w) & (y >= 0) & (y < h)  # NaN is not
        if seen.any():
            shares.append(float(mask[y[seen].astype(int), x[seen].astype(int)].mean()))
    return max(shares)


def box_of(mask: Bool[np.ndarray, "h w"]) -> Box:
    """The box about a mask that is not empty, pixels."""
    rows, columns = (np.flatnonzero(mask.any(axis)) for axis in (1, 0))
    return (float(columns[0]), float(rows[0]), float(columns[-1] + 1), float(rows[-1] + 1))


def around(box: Box, shape: tuple[int, int]) -> Box:
    """A square with room about a box."""
    x, y = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
    half = max(ROOM * (box[2] - box[0]), ROOM * (box[3] - box[1]), NEAREST * max(shape)) / 2
    return within((x - half, y - half, x + half, y + half), shape)


def within(box: Box, shape: tuple[int, int]) -> Box:
    """A box moved into a frame, as far as it is not larger."""
    low = [np.clip(a, 0, max(n - (b - a), 0)) for a, b, n in
           ((box[0], box[2], shape[1]), (box[1], box[3], shape[0]))]  # fmt: skip
    return (float(low[0]), float(low[1]), float(low[0] + box[2] - box[0]),
            float(low[1] + box[3] - box[1]))  # fmt: skip
