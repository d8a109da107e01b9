"""Equal objects that were clicked, followed together: what one of them is, no other can be.

Looks do not tell equal objects apart. A frame says only where such objects are, and each place is
taken by one of them at most; which is which follows from their paths. Of all joint paths, the
hypotheses, the cheapest is found by a search that keeps the best few (multiple hypothesis tracking,
Reid 1979), and what others cost more says how sure each frame is (soft-output Viterbi, Hagenauer
and Hoeher 1989): after a crossing that several hypotheses explain, it is not known which is which.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from hoigs.plugins.estimators.object_tracker.appearance import (
    Appearance,
    learnt_beside_twins,
    twins_of,
)
from hoigs.plugins.estimators.object_tracker.footage import Footage, Window
from hoigs.plugins.estimators.object_tracker.path import Evidence, center_of, object_odds
from hoigs.plugins.estimators.object_tracker.places import Place, Shape, places_of
from hoigs.plugins.estimators.object_tracker.prompts import AT_PERSON, SCENE, PromptedMask, walked
from hoigs.plugins.estimators.object_tracker.propagation import Track
from hoigs.plugins.estimators.object_tracker.scene import Scene, StaticScene
from hoigs.plugins.estimators.object_tracker.tracker import at_rest, color_model, masks_of

Twins = Mapping[int, Bool[np.ndarray, "h w"]]  # by frame


def groups_of(
    prompts: Mapping[str, Sequence[PromptedMask]], twins: Mapping[str, Twins]
) -> list[tuple[int, list[str]]]:
    """Objects that were clicked in one frame and look alike, and that frame; one object alone where
    what looks like it was not clicked.

    Args:
        twins: of each clicked object, the pixels of what looks like it (`twins_of`).
    """
    masks = {n: masks_of(found) for n, found in prompts.items()}

    def alike(a: str, b: str, frame: int) -> bool:
        like = twins[a].get(frame)
        return like is not None and bool(like[masks[b][frame]].mean() > 0.5)

    groups: list[tuple[int, list[str]]] = []
    for name in (n for n in twins if twins[n]):
        if any(name in group for _, group in groups):
            continue
        frame = min(twins[name])
        clicked = [n for n in twins if frame in masks[n] and not any(n in g for _, g in groups)]
        group = [name]
        for member in group:  # which grows
            group += [
                n for n in clicked
                if n not in group and (alike(member, n, frame) or alike(n, member, frame))
            ]  # fmt: skip
        groups.append((frame, group))
    return groups


WATCHED = 24  # frames in which a rival is looked at
CHANGED = 0.25  # of a rival and its rim: what differs from the scene if it moves


def rivals_of(
    footage: Footage, scene: Scene, looks: Appearance, known: Mapping[int, Bool[np.ndarray, "h w"]]
) -> Twins:
    """The `twins_of` an object that may be taken for it: before a static camera, if somebody holds
    the object where it was clicked, or it is no part of the scene there, those that move, unlike a
    picture on the wall."""
    found = {}
    for i, twins in twins_of(looks, known).items():
        labels, count = ndimage.label(twins)
        every = [*range(1, count + 1)]
        held = footage.person[i][known[i]].mean() > AT_PERSON
        if isinstance(scene, StaticScene) and (held or not at_rest(scene, {i: known[i]})):
            every = [k for k in every if _ever_moves(footage, scene, labels == k)]
        if every:
            found[i] = np.isin(labels, every)
    return found


def _ever_moves(footage: Footage, scene: Scene, region: Bool[np.ndarray, "h w"]) -> bool:
    """Whether a region differs from the scene in any frame, people before it left out."""
    for i in np.unique(np.linspace(0, len(footage) - 1, WATCHED).astype(int)):
        seen = region & ~footage.person[i]
        changed = (scene.difference(i)[seen] > SCENE).sum()
        if 2 * seen.sum() > region.sum() and changed > CHANGED * seen.sum():
            return True
    return False


# Joint paths through the places of all frames.

STEADY = (0.1, 0.3)  # breadths a frame by which motions change: least and, at first, most
MOVES = 0.05  # breadths a frame from which an object moves
FAR = 8.0  # cost of a place that cannot be reached
COVERED, GONE = 1.0, 3.0  # cost of a frame without it; of the first two, if nothing hides it
BEHIND, ON_PERSON = 0.8, 0.3  # breadths from another object, and share of people, that hide one
STRANGE = 4.0  # cost of a place that is none of the objects, if nothing else covers it
KEPT, BEYOND = 40, 10.0  # hypotheses that are kept; what they may cost more than the best
SAME = 0.5  # breadths within which two hypotheses have an object in one place
RESTS, AS_BEFORE = 0.7, 6.0  # share of a place that looks as before, within so many units of colour
CLEAR = 2.0  # what other hypotheses cost more, from which a frame is sure
LONG = 12  # frames in a row that are not sure, after which an object's path ends


@dataclass(frozen=True)
class View:
    """What the hypotheses need of a frame.

    Attributes:
        places: middles x, y. new: the share of each that no other covers. rests: whether it looks
            as in the frame before. given: places of clicked objects, by their rows.
        covers: whether a person or the picture's edge hides a place x, y.
    """

    i: int
    places: Float[np.ndarray, "P 2"]
    new: Float[np.ndarray, "P"]
    rests: Bool[np.ndarray, "P"]
    given: Mapping[int, int]
    covers: Callable[[Float[np.ndarray, "2"]], bool]


@dataclass(frozen=True)
class Hypothesis:
    """One joint path of N objects through the frames so far.

    Attributes:
        breadth: of an object, pixels. steady: pixels a frame by which motions change.
        at, speed, age: of each object where it was last seen, its step there, and the frames since.
        before: frames that its step there took, of which the more the less sure it is.
        trail: places x, y of all F frames, NaN where hidden. margin: what the cheapest other
            hypothesis that has the object elsewhere in a frame costs more.
    """

    cost: float
    breadth: float
    steady: float
    at: Float[np.ndarray, "N 2"]
    speed: Float[np.ndarray, "N 2"]
    age: tuple[int, ...]
    before: tuple[int, ...]
    trail: Float[np.ndarray, "N F 2"]
    margin: Float[np.ndarray, "N F"]

    @classmethod
    def starting(
        cls, breadth: float, at: Float[np.ndarray, "N 2"], frame: int, count: int
    ) -> Hypothesis:
        """The hypothesis that begins in one of `count` frames, in which all places are known."""
        n = len(at)
        trail, margin = np.full((n, count, 2), np.nan), np.full((n, count), np.inf)
        trail[:, frame] = at
        once, rest = (1,) * n, np.zeros_like(at)
        return cls(0.0, breadth, STEADY[1] * breadth, at, rest, once, once, trail, margin)

    def merged(self, other: Hypothesis) -> Hypothesis:
        """This hypothesis, with another that costs more and is not followed any further."""
        a, b = (np.nan_to_num(w.trail, nan=-1e4) for w in (self, other))
        apart = np.hypot(*np.moveaxis(a - b, -1, 0)) > SAME * self.breadth
        more = other.cost - self.cost + np.where(apart, 0.0, other.margin)
        return replace(self, margin=np.minimum(self.margin, more))

    def continued(self, view: View) -> list[tuple[tuple, Hypothesis]]:
        """The hypotheses that continue it in a frame, and the key of those that end alike."""
        choices: list[tuple[float, tuple[int, ...]]] = [(0.0, ())]
        taken = set(view.given.values())
        for k in range(len(self.at)):
            options = [
                (cost, p) for p, cost in enumerate(self._costs(k, view), -1)
                if (p == view.given[k] if k in view.given else p not in taken)
            ]  # fmt: skip
            longer = [
                (cost + c, (*chosen, p))
                for cost, chosen in choices
                for c, p in options
                if p < 0 or p not in chosen
            ]
            choices = sorted(longer)[:KEPT]
        seen = [[p for p in chosen if p >= 0] for _, chosen in choices]
        cost = self.cost + np.array([c for c, _ in choices])
        cost += STRANGE * np.array([view.new.sum() - view.new[s].sum() for s in seen])
        found = []
        for k in np.flatnonzero(cost < cost.min() + BEYOND).tolist():
            chosen = choices[k][1]
            path = self._moved(view, chosen, float(cost[k]))
            found.append(((chosen, tuple(path.at[np.less(chosen, 0)].ravel())), path))
        return found

    def _moved(self, view: View, chosen: Sequence[int], cost: float) -> Hypothesis:
        """Each object at the place chosen for it; -1: it is hidden."""
        at, speed, trail = self.at.copy(), self.speed.copy(), self.trail.copy()
        for k, p in enumerate(chosen):
            if p >= 0:
                speed[k] = (view.places[p] - at[k]) / self.age[k]
                at[k] = trail[k, view.i] = view.places[p]
        seen = [p >= 0 for p in chosen]
        before = tuple(np.where(seen, self.age, self.before).tolist())
        age = tuple(np.where(seen, 1, np.add(self.age, 1)).tolist())
        moved = replace(self, cost=cost, at=at, speed=speed, trail=trail)
        return replace(moved, age=age, before=before)

    def _costs(self, k: int, view: View) -> list[float]:
        """Costs of an object's being hidden, and of its being at each of the places."""
        age, speed = self.age[k], self.speed[k]
        off = view.places - self.at[k]
        away = _beside(off, age * speed)
        doubt = age + self.before[k] - 1
        cost = np.minimum(0.5 * (away / self.steady) ** 2 / doubt, FAR + 0.2 * away / self.breadth)
        if k not in view.given:  # nothing came to a place that looks as before
            cost[view.rests & (np.hypot(*off.T) > SAME * self.breadth)] = np.inf
        now = self.at[k] + age * speed
        beside = np.hypot(*(view.places - now).T).min(initial=np.inf)
        hidden = age > 2 or view.covers(now) or beside < BEHIND * self.breadth
        return [COVERED if hidden else GONE, *cost.tolist()]


def _beside(
    off: Float[np.ndarray, "P 2"], motion: Float[np.ndarray, "2"] | Float[np.ndarray, "P 2"]
) -> Float[np.ndarray, "P"]:
    """How far places are from where a motion leads, on which an object may stop anywhere."""
    share = (off * motion).sum(-1) / np.maximum((motion * motion).sum(-1), 1e-9)
    return np.hypot(*(off - np.clip(share, 0, 1)[:, None] * motion).T)


def steadiness(hypotheses: Sequence[Hypothesis]) -> float:
    """Pixels a frame by which motions change, about: the root of their mean square."""
    steps = [np.diff(path.trail, axis=1) for path in hypotheses]
    before = np.concatenate([s[:, :-1].reshape(-1, 2) for s in steps])
    then = np.concatenate([s[:, 1:].reshape(-1, 2) for s in steps])
    moves = np.hypot(*before.T) + np.hypot(*then.T) > MOVES * hypotheses[0].breadth
    least, most = (share * hypotheses[0].breadth for share in STEADY)
    changes = _beside(then[moves], before[moves])
    return float(np.clip(np.sqrt(np.mean(changes**2)), least, most)) if moves.any() else most


def cheapest(start: Hypothesis, views: Sequence[View]) -> Hypothesis:
    """The cheapest hypothesis from a start on, with what others cost more."""
    hypotheses = [start]
    for view in views:
        kept: dict[tuple, Hypothesis] = {}
        for key, path in sorted(
            (e for w in hypotheses for e in w.continued(view)), key=lambda e: e[1].cost
        ):
            kept[key] = kept[key].merged(path) if key in kept else path
        hypotheses = [
            w for w in kept.values() if w.cost < min(k.cost for k in kept.values()) + BEYOND
        ]
        hypotheses = hypotheses[:KEPT]
    best, *rest = hypotheses
    for path in rest:
        best = best.merged(path)
    return best


def lasting(sure: Bool[np.ndarray, " F"]) -> Bool[np.ndarray, " F"]:
    """Frames in which it is sure where an object is, up to the first LONG in a row in which it is
    not: an object that was not seen for so long may have been put down anywhere."""
    run = 0
    for i, seen in enumerate(sure):
        run = 0 if seen else run + 1
        if run == LONG:
            return sure & (np.arange(len(sure)) < i)
    return sure


# Masks at the places of the cheapest hypothesis.

WHOLE = 0.4  # share of a place in the clicked frame from which it is an object, too
MORE = 12  # places that are looked for beyond those that were clicked
RIM = 0.15  # breadths beyond its shape that may be an object's
LEAST = 0.3  # of the clicked area: a smaller mask is none
OVER = 0.02  # of it: shapes that have less in common do not hide each other


def followed_together(
    footage: Footage,
    prompts: Mapping[str, Sequence[PromptedMask]],
    first: int,
    progress: Callable[[float], None] = lambda share: None,
) -> dict[str, Track]:
    """Tracks of equal objects that were all clicked in the frame `first`, and perhaps in others.

    What looks like them there and was not clicked is followed, too, so that none of them becomes
    it. Frames in which it is not sure which is which have an empty mask.
    """
    evidence, masks = _evidence(footage, prompts), [masks_of(f) for f in prompts.values()]
    clicked = [p for found in prompts.values() for p in found if p.frame == first]
    shape = Shape.of(max(clicked, key=lambda p: p.quality).soft > 0.5)
    places, count = [], len(footage)
    for i in range(count):
        known = [np.array(center_of(m[i])) for m in masks if i in m]
        odds, most = object_odds(evidence, i), len(masks) + MORE
        places.append(places_of(odds, footage.person[i], shape, known, most))
        progress(0.7 * (i + 1) / count)
    at = [p.middle for k, p in enumerate(places[first]) if k < len(masks) or p.new > WHOLE]
    start = Hypothesis.starting(shape.breadth, np.array(at), first, count)

    def view(i: int, last: int) -> View:
        given = [k for k, m in enumerate(masks) if i in m]
        return View(
            i, np.array([p.middle for p in places[i]]).reshape(-1, 2),
            np.array([p.new for p in places[i]]),
            np.array([_rests(footage, shape.drawn(p.middle), i, last) for p in places[i]], bool),
            dict(zip(given, range(len(given)))), lambda to: _covers(footage, shape, i, to),
        )  # fmt: skip

    forth = [view(i, i - 1) for i in range(first + 1, count)]
    back = [view(i, i + 1) for i in range(first - 1, -1, -1)]
    for _ in range(2):  # how steady they move is known after the first time
        after, before = cheapest(start, forth), cheapest(start, back)
        start = replace(start, steady=steadiness((after, before)))
    tracks = {n: Track(np.zeros(footage.lab.shape[:3], np.uint8), np.zeros(count)) for n in prompts}
    sure = np.array([np.isfinite(w.trail).all(2) & (w.margin > CLEAR) for w in (before, after)])
    sure = np.where(np.arange(count) < first, *sure)
    for row, found in zip(sure, prompts.values()):
        last, once = max(p.frame for p in found), min(p.frame for p in found)
        row[last:], row[once::-1] = lasting(row[last:]), lasting(row[once::-1])
    for i in range(count):
        path = after if i >= first else before
        drawn = _masks(evidence, shape, i, places[i], path.trail[:, i])
        for k, (name, track) in enumerate(tracks.items()):
            if k in drawn and sure[k, i]:
                track.soft[i], track.confidence[i] = drawn[k]
            for p in (p for p in prompts[name] if p.frame == i):
                track.soft[i], track.confidence[i] = np.rint(p.soft * 255), 1.0
        progress(0.7 + 0.3 * (i + 1) / count)
    return tracks


def _evidence(footage: Footage, prompts: Mapping[str, Sequence[PromptedMask]]) -> Evidence:
    """What speaks for any of the objects, learnt from all of them."""
    every = [p for found in prompts.values() for p in found]
    frames = sorted({p.frame for p in every})
    soft = {i: np.max([p.soft for p in every if p.frame == i], 0) for i in frames}
    looks, twins = learnt_beside_twins(footage, {i: soft[i] > 0.5 for i in frames})
    return Evidence(footage, None, color_model(footage, soft, twins), looks)


def _rests(footage: Footage, mask: Bool[np.ndarray, "h w"], i: int, last: int) -> bool:
    away = np.abs(footage.colors(i)[mask] - footage.colors(last)[mask]).max(1)
    return bool((away < AS_BEFORE).sum() > RESTS * mask.sum())


def _covers(footage: Footage, shape: Shape, i: int, to: Float[np.ndarray, "2"]) -> bool:
    x, y = to.astype(int)
    r, (h, w) = max(1, int(0.4 * shape.breadth)), footage.shape
    if not (r <= x < w - r and r <= y < h - r):
        return True
    return bool(footage.person[i][y - r : y + r, x - r : x + r].mean() > ON_PERSON)


def _masks(
    evidence: Evidence,
    shape: Shape,
    i: int,
    places: Sequence[Place],
    trail: Float[np.ndarray, "N 2"],
) -> dict[int, tuple[UInt8[np.ndarray, "h w"], float]]:
    """Soft masks of the objects in a frame, and how probable they are by the looks: what looks like
    the objects belongs to the one whose shape it is in, or nearest to."""
    footage, odds, found = evidence.footage, object_odds(evidence, i), {}
    away = _away(footage, shape, i, places)
    for k in np.flatnonzero(np.isfinite(trail).all(1)).tolist():
        p = int(np.argmin([np.hypot(*(place.middle - trail[k])) for place in places]))
        mine = (away.argmin(0) == p) & (away[p] < RIM * shape.breadth)
        x, y = trail[k].tolist()
        window = Window.around(x, y, 1.2 * shape.breadth)
        says = np.where(window.cut(mine) > 0.5, window.cut(odds), -9)
        soft = walked(says, window.cut(footage.colors(i)))
        labels, _ = ndimage.label(soft > 0.5)
        areas = np.bincount(labels.ravel(), minlength=2)[1:]
        if areas.max() * window.step**2 < LEAST * shape.mask.sum():
            continue
        kept = ndimage.binary_fill_holes(labels == 1 + areas.argmax())
        probable = float((1 / (1 + np.exp(-window.cut(odds)[kept]))).mean())
        found[k] = window.paste(np.where(kept, np.maximum(soft, 0.6), 0), footage.shape), probable
    return found


def _away(
    footage: Footage, shape: Shape, i: int, places: Sequence[Place]
) -> Float[np.ndarray, "P h w"]:
    """Distances of pixels from the shapes at places, negative inside, as far as an object may reach
    beyond its shape. What two have in common is the one's that is before the other: whose rim is an
    edge of the picture there."""
    drawn = [shape.drawn(p.middle) for p in places]
    far = [_distances(d, int(RIM * shape.breadth) + 2) for d in drawn]
    light = ndimage.gaussian_filter(footage.colors(i)[..., 0], 1.0)
    steep = np.hypot(*np.gradient(light))
    rims = [d ^ ndimage.binary_erosion(d) for d in drawn]
    for a in range(len(drawn)):
        for b in range(a):
            both = drawn[a] & drawn[b]
            if both.sum() > OVER * shape.mask.sum():
                mine, theirs = (steep[rims[p] & drawn[q]].mean() for p, q in ((a, b), (b, a)))
                near, behind = (a, b) if mine > theirs else (b, a)
                far[behind][both] = np.maximum(far[behind], far[near] + 1)[both]
    return np.array(far).reshape(-1, *footage.shape)


def _distances(drawn: Bool[np.ndarray, "h w"], reach: int) -> Float[np.ndarray, "h w"]:
    """Of pixels from a shape, negative inside; farther than `reach` they are `reach` or more."""
    found = np.full(drawn.shape, float(reach))
    for box in ndimage.find_objects(drawn.astype(np.uint8)):
        near = tuple(slice(max(0, side.start - reach), side.stop + reach) for side in box)
        cut = drawn[near]
        found[near] = ndimage.distance_transform_edt(~cut) - ndimage.distance_transform_edt(cut)
    return found
