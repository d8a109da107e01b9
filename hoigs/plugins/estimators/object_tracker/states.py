"""Where an object is in the frames that do not show it, and whether the others do: doubtful."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Int

from hoigs.plugins.estimators.object_tracker.footage import (
    SAMPLED,
    SLEEVES,
    TORSO,
    TRUNK,
    Footage,
    bins_of,
    histogram,
    limbs,
    torso_length,
    usual_torso,
)
from hoigs.plugins.estimators.object_tracker.footage import (
    SEEN as VISIBLE,
)
from hoigs.plugins.estimators.object_tracker.path import center_of
from hoigs.plugins.estimators.object_tracker.prompts import (
    OF_PERSON,
    lies_on_people,
    like_limbs,
)
from hoigs.plugins.estimators.object_tracker.propagation import Track

SEEN, OUT, LOST, PERSON = "seen", "out of the picture", "lost", "hidden by a person"
DOUBTFUL = "doubtful"  # there is a mask, and it may be a part of a person or of the scene
WORN, FEWEST = 0.9, 5  # share of a mask, and of the frames, that are clothes; frames that say so
CLOTHED, COVERS = 0.85, 0.35  # share of a shirt that torso and sleeves hold, and of the torso
BARE = (0, 9, 10, 15, 16, 19, 20)  # landmarks of face and hands
AROUND = 0.07  # torsos about these that are skin
LIKE_SKIN = 0.72  # likeness of colours from which a thing is rather skin
HANDS, OF_HAND = range(15, 23), 0.16  # landmarks of hands, and torsos about these that are hands
HANDED = 0.17  # share of a mask that is hands, from which it takes them in
RIM = 2  # pixels from the edge of the picture within which a mask reaches it
RECENT = 8  # frames before it was seen last that say how it moved
BEYOND = 0.5  # of what was seen of it last: what has less left in the picture is out of it
COVERED = 0.5  # share of its place from which something hides it
SAME_PLACE = 1.5  # breadths between the sightings around a gap, up to which it stayed about there


def states_of(
    footage: Footage,
    tracks: Mapping[str, Track | None],
    led: Mapping[str, Bool[np.ndarray, " F"]] | None = None,
) -> dict[str, list[str]]:
    """The state of each object in each frame.

    An object that moved over the edge of the picture where it was last seen, or moves in where it
    is seen next, is out of it; one that was seen before and after in about one place, which a
    person or another object covers meanwhile, is hidden. Of all else nothing is known: it is lost.
    A mask on a person whose colours the rest of them has, too, is doubtful: a hand that held the
    object, or a shirt.

    Args:
        led: of each object, frames in which it is certain whatever colours it has.
    """
    masks = {name: None if t is None else t.soft > 127 for name, t in tracks.items()}
    found = {}
    for name, own in masks.items():
        if own is None:
            found[name] = [LOST] * len(footage)
            continue
        others = {n: m for n, m in masks.items() if n != name and m is not None}
        seen = np.flatnonzero(own.any((1, 2)))
        certain = (led or {}).get(name, np.zeros(len(footage), bool))
        states = [
            LOST if not m.any()
            else DOUBTFUL if not certain[i] and lies_on_people(footage, i, m, OF_PERSON)
            else SEEN
            for i, m in enumerate(own)
        ]  # fmt: skip
        for i in np.flatnonzero(~own.any((1, 2))).tolist():
            around = [*seen[seen < i][-1:], *seen[seen > i][:1]]
            if _left(own, seen[seen < i][::-1], i) or _left(own, seen[seen > i], i):
                states[i] = OUT
            elif len(around) == 2:
                states[i] = _hidden(footage, own[around[0]], own[around[1]], others, i)
        found[name] = states
    return found


def mostly_doubtful(states: Sequence[str]) -> bool:
    """Whether more than half of an object's masks are doubtful: they are rather of something else,
    and a training with them would learn that."""
    doubtful, seen = (states.count(state) for state in (DOUBTFUL, SEEN))
    return doubtful > seen


def is_worn(
    masks: Bool[np.ndarray, "F h w"], people: Sequence[Float[np.ndarray, "F 33 4"]]
) -> bool:
    """Whether an object never leaves the torso and thighs of one person: rather their clothes.

    Frames in which the person's torso is not seen say nothing.

    Args:
        masks: of the object. people: landmarks of each person, pixels and visibility.
    """
    for landmarks in people:
        torso, within = torso_length(landmarks), []
        for i in np.flatnonzero(masks.any((1, 2))):
            trunk = limbs(masks.shape[1:], landmarks[i], torso[i], TRUNK)
            within += [] if trunk is None else [trunk[masks[i]].mean() > WORN]
        if len(within) >= FEWEST and np.mean(within) > WORN:
            return True
    return False


def covers_torso(
    masks: Bool[np.ndarray, "F h w"], people: Sequence[Float[np.ndarray, "F 33 4"]]
) -> bool:
    """Whether an object covers much of one person's torso and hardly reaches beyond torso, thighs
    and upper arms: their shirt, which sleeves and folds make larger than `is_worn` allows.

    Frames in which the person's torso is not seen say nothing.

    Args:
        masks: of the object. people: landmarks of each person, pixels and visibility.
    """
    for landmarks in people:
        length, within, covered = torso_length(landmarks), list[float](), list[float]()
        for i in np.flatnonzero(masks.any((1, 2))):
            of_body = partial(limbs, masks.shape[1:], landmarks[i], length[i])
            torso, clothes = of_body(TORSO), of_body((*TRUNK, *SLEEVES))
            if torso is not None and clothes is not None:
                within.append(float(clothes[masks[i]].mean()))
                covered.append(float(masks[i][torso].mean()))
        if len(within) >= FEWEST and np.mean(within) > CLOTHED and np.mean(covered) > COVERS:
            return True
    return False


def looks_like_skin(
    footage: Footage,
    masks: Bool[np.ndarray, "F h w"],
    people: Sequence[Float[np.ndarray, "F 33 4"]],
) -> bool:
    """Whether an object has the colours of people's faces and hands over the video: rather a bare
    arm or leg, whose landmarks are wrong. False where nobody's skin or size is known.

    Args:
        masks: of the object. people: landmarks of each person, pixels and visibility.
    """
    reach, shown = AROUND * usual_torso(people), np.flatnonzero(masks.any((1, 2))).tolist()
    if not np.isfinite(reach) or not shown:
        return False
    y, x = np.mgrid[: masks.shape[1], : masks.shape[2]] + 0.5
    skin = []
    for i in np.unique(np.linspace(0, len(masks) - 1, 2 * SAMPLED).astype(int)).tolist():
        places = [p[i, k, :2] for p in people for k in BARE if p[i, k, 3] > VISIBLE]
        near = [np.hypot(x - at[0], y - at[1]) < reach for at in places]
        bare = np.any(near, axis=0) & footage.person[i] & ~masks[i]
        skin += [histogram(bins_of(footage.colors(i)), bare * 1.0)] if bare.any() else []
    if not skin:
        return False
    usual = np.sqrt(np.mean(skin, 0))
    own = [histogram(bins_of(footage.colors(i)), masks[i] * 1.0) for i in shown]
    return float(np.median(np.sqrt(own) @ usual)) > LIKE_SKIN


def takes_in_hands(
    footage: Footage,
    masks: Bool[np.ndarray, "F h w"],
    people: Sequence[Float[np.ndarray, "F 33 4"]],
) -> bool:
    """Whether the hands that hold an object are in its masks, in most frames: much of these is near
    landmarks of hands and has colours as common along limbs. False where people's size, or the
    colours of their limbs, are not known.

    Args:
        masks: of the object. people: landmarks of each person, pixels and visibility.
    """
    reach = OF_HAND * usual_torso(people)
    if footage.limbs is None or not np.isfinite(reach):
        return False
    shares = []
    for i in np.flatnonzero(masks.any((1, 2))).tolist():
        y, x = np.nonzero(masks[i])
        seen = [p[i, k, :2] for p in people for k in HANDS if p[i, k, 3] > VISIBLE]
        near = [np.hypot(x + 0.5 - at[0], y + 0.5 - at[1]) < reach for at in seen]
        alike = like_limbs(footage.limbs, bins_of(footage.colors(i))[masks[i]])
        shares.append(float((alike * np.any(near, axis=0)).mean()) if near else 0.0)
    return bool(shares) and float(np.median(shares)) > HANDED


def _left(masks: Bool[np.ndarray, "F h w"], seen: Int[np.ndarray, " S"], i: int) -> bool:
    """Whether an object is beyond an edge of the picture in frame `i`, as it moved while seen.

    What counts is how far it reached from the edge into the picture: of an object that goes out
    the rest moves on as before, while its middle slows down. One mask at the edge says nothing.

    Args:
        seen: frames on one side of `i` that show it, the nearest first.
    """
    near = [k for k in seen.tolist() if abs(k - seen[0]) < RECENT]
    if len(near) < 2:
        return False
    times = [abs(k - i) for k in near]
    for turns in range(4):  # each edge in turn is the upper one
        reach = [int(np.flatnonzero(np.rot90(masks[k], turns).any(1)).max()) + 1 for k in near]
        if not np.rot90(masks[near[0]], turns)[:RIM].any():
            continue
        inwards = np.polyfit(times, reach, 1)[0]  # pixels a frame, away from `i`
        if reach[0] - inwards * times[0] < BEYOND * reach[0]:
            return True
    return False


def _hidden(
    footage: Footage,
    before: Bool[np.ndarray, "h w"],
    after: Bool[np.ndarray, "h w"],
    others: Mapping[str, Bool[np.ndarray, "F h w"]],
    i: int,
) -> str:
    """What covers the place of an object that stayed about where it was, in frame `i`."""
    way = np.subtract(center_of(before), center_of(after))
    if np.hypot(*way) > SAME_PLACE * np.sqrt(before.sum()):
        return LOST
    for name, masks in others.items():
        if masks[i][before].mean() > COVERED:
            return f"hidden by {name}"
    return PERSON if footage.person[i][before].mean() > COVERED else LOST
