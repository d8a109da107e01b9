"""Which masks of a track are proven to show the object, and where it is in the other frames.

A tracker always finds something. Its mask is believed where the looks that were learnt in other
frames and the nearest of the cells known there agree that it is the object, where its size is one
that the object has about then, where it does not lie on what was there while the object was
elsewhere, and where it did not jump. Where looks are not sure, as of a thing that glares, it is
believed as far as the motion of its own pixels carries a proven mask there; where looks are sure,
it is not if that motion leads beside the object, to what was seen there with it. All other masks
are dropped: none is better than a wrong one.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, field
from itertools import takewhile

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage
from torch import Tensor

from hoigs.plugins.estimators.object_tracker.appearance import (
    CELLS,
    FREE,
    Appearance,
    cell_features,
    cell_shares,
    half_breadth,
)
from hoigs.plugins.estimators.object_tracker.footage import Footage, to_features
from hoigs.plugins.estimators.object_tracker.motion import moved_on
from hoigs.plugins.estimators.object_tracker.path import center_of
from hoigs.plugins.estimators.object_tracker.prompts import (
    OF_PERSON,
    PromptedMask,
    lies_on_people,
    of_person,
    overlap,
)
from hoigs.plugins.estimators.object_tracker.propagation import Track
from hoigs.plugins.estimators.object_tracker.scene import Scene, StaticScene, carried

SIZES = (0.3, 1.5)  # of its usual area about then: half hidden, and not with a thing beside it
AROUND = 6  # proven frames before and after a frame that say what is usual
AGAIN = 0.05  # more agreement that is asked for after each frame without it
STEP = 1.5  # diameters a frame beside what the motion foretells: farther is a jump
SAME = 6.0  # units of colour within which a place looks as it did
THERE = 0.7  # share of a mask that looks as it did while the object was elsewhere
NEAREST = 12  # frames that are believed and nearest in time, with which a frame is compared
FEW, FADED = 0.3, 0.5  # of a mask: share before a known scene, and of its difference from it then
MORE = 0.15  # how much more a mask on people has of their colours than the clicked one
SHARED = 0.5  # of the pixels of a mask: those that move together
ARRIVES = 0.6  # overlap of a mask that was moved on with the one it comes to
APART, LONG = 0.5, 8  # overlap up to which masks are compared by motion, and frames between them
BESIDE = 0.3  # overlap with a mask below which what is moved there is something else
BANK = 4000  # cells of other things that are compared with


@dataclass(frozen=True)
class Bounds:
    """Agreements that are asked for.

    Attributes:
        proven: by itself. carried: between proven frames, without a gap. moved: where motion leads
            from one. again: at most, of a frame before which it was not seen for long.
    """

    proven: float = 0.5
    carried: float = 0.3
    moved: float = 0.1
    again: float = 0.7

    def halved(self) -> Bounds:
        """With half of the doubt that is left otherwise."""
        return Bounds(*((1 + bound) / 2 for bound in astuple(self)))


@dataclass(frozen=True)
class Proof:
    """What speaks for the masks of a track.

    Attributes:
        agreement: of each frame, the lesser of the mean probability of its mask's cells by the
            looks, and of the share of them that is nearer to a known cell of the object than to one
            of anything else; 0 where the mask is empty. proven: the frames that are believed.
        arrived: of frames that are by motion alone, the overlap with the mask it carries there.
    """

    agreement: Float[np.ndarray, " F"]
    proven: Bool[np.ndarray, " F"]
    arrived: Mapping[int, float]


def proof_of(
    footage: Footage,
    scene: Scene,
    prompts: Sequence[PromptedMask],
    track: Track,
    looks: Appearance,
    known: Mapping[int, Bool[np.ndarray, "h w"]],
    beside_alike: bool = False,
) -> Proof:
    """The frames whose mask shows what was prompted.

    Args:
        known: masks of the prompted frames, and perhaps of further ones that are proven. looks:
            learnt from these. beside_alike: looks take other things for the object, although they
            were told that they are others.
    """
    bounds = Bounds().halved() if beside_alike else Bounds()
    masks = track.soft > 127
    given = [p.frame for p in prompts]
    bank = _Bank.of(footage, looks, known)
    agreement = np.array([_agreement(bank, looks, i, m) for i, m in enumerate(masks)])
    agreement[given] = 1.0
    most = max(OF_PERSON, MORE + max(of_person(footage, i, known[i]) for i in given))
    believed = {i: known[i] for i in given}
    for i in np.argsort(-agreement, kind="stable").tolist():
        if i in believed or agreement[i] < bounds.carried:
            continue
        near = sorted(believed, key=lambda j: abs(i - j))[:NEAREST]
        if (
            any(_as_before(footage, scene, i, masks[i], j, believed[j]) for j in [*given, *near])
            or any(_uncovered(footage, scene, i, masks[i], j, known[j]) for j in given)
            or lies_on_people(footage, i, masks[i], most)
        ):
            agreement[i] = 0.0
        elif agreement[i] >= bounds.proven:
            believed[i] = masks[i]
    area = masks.sum((1, 2)).astype(float)
    agreement[~_usual_size(area, agreement >= bounds.proven, given)] = 0.0
    motions = Motions(footage, masks)
    proven = _continued(masks, agreement, given, bounds, motions)
    return Proof(agreement, proven, motions.arrived)


@dataclass(frozen=True)
class _Bank:
    """Features of known cells: the object's, and those of all else.

    A cell's features are also those of what is around it. For the cells of a flat thing that is
    what it is in front of, which changes, if they are not small beside its shorter axis.

    Attributes:
        side: of a cell, pixels. mean, spread: of the features.
    """

    footage: Footage
    side: int
    mean: Float[Tensor, "C"]
    spread: Float[Tensor, "C"]
    inside: Float[Tensor, "N C"]
    outside: Float[Tensor, "M C"]

    @classmethod
    def of(
        cls, footage: Footage, looks: Appearance, known: Mapping[int, Bool[np.ndarray, "h w"]]
    ) -> _Bank:
        half = float(np.mean([half_breadth(mask) for mask in known.values()]))
        side = min(looks.side, max(1, round(half / CELLS)))
        inside, outside = [], []
        frames = {i: cell_features(footage.colors(i), side).flatten(1).T for i in known}
        every = torch.cat(list(frames.values()))
        mean, spread = every.mean(0), every.std(0) + 1e-3
        for i, mask in known.items():
            cells = (frames[i] - mean) / spread
            share = torch.from_numpy(cell_shares(mask, side).ravel())
            inside.append(cells[share > 0.5])
            free = torch.from_numpy(cell_shares(~mask, side).ravel())
            rest = cells[free > 1 - FREE]
            outside.append(rest[:: max(1, len(known) * len(rest) // BANK)])
        return cls(footage, side, mean, spread, torch.cat(inside), torch.cat(outside))

    def nearer(self, i: int, mask: Bool[np.ndarray, "h w"]) -> float:
        """The share of a mask's cells that are nearer to one of the object's."""
        own = _cells_of(mask, self.side)
        if not own.any() or not len(self.inside) or not len(self.outside):
            return 0.0
        every = cell_features(self.footage.colors(i), self.side).flatten(1).T
        cells = (every[torch.from_numpy(own.ravel())] - self.mean) / self.spread
        near, far = (torch.cdist(cells, b).min(1).values for b in (self.inside, self.outside))
        return float((near < far).float().mean())


def _cells_of(mask: Bool[np.ndarray, "h w"], side: int) -> Bool[np.ndarray, "r c"]:
    """The cells that are a mask's; those it has most of where it has none alone."""
    share = cell_shares(mask, side)
    return share > min(0.6, 0.9 * share.max())


def _agreement(bank: _Bank, looks: Appearance, i: int, mask: Bool[np.ndarray, "h w"]) -> float:
    own = _cells_of(mask, looks.side)
    if not own.any():
        return 0.0
    alike = float((1 / (1 + np.exp(-looks.cells(i)[own]))).mean())
    return min(alike, bank.nearer(i, mask))


def _as_before(
    footage: Footage,
    scene: Scene,
    i: int,
    mask: Bool[np.ndarray, "h w"],
    other: int,
    known: Bool[np.ndarray, "h w"],
) -> bool:
    """Whether a place of frame `i` looks as it does in another one, in which the object is
    elsewhere: it shows something else in both."""
    y, x = np.nonzero(mask)
    to = np.floor(carried(scene, np.stack((x, y), -1) + 0.5, i, other)).astype(int)
    inside = ((to >= 0) & (to < np.array(footage.shape[::-1]))).all(1)
    row, column = to[inside].T[::-1]
    elsewhere = (~known & ~footage.blank[other])[row, column]
    if not len(row) or elsewhere.mean() < THERE:
        return False
    here, there = footage.lab[i][y[inside], x[inside]], footage.lab[other][row, column]
    away = np.abs(to_features(here[elsewhere]) - to_features(there[elsewhere])).max(1)
    return bool((away < SAME).mean() > THERE)


def _uncovered(
    footage: Footage,
    scene: Scene,
    i: int,
    mask: Bool[np.ndarray, "h w"],
    prompted: int,
    known: Bool[np.ndarray, "h w"],
) -> bool:
    """Whether a place shows the still scene, from which it differed when the object was there."""
    same_place = ndimage.binary_dilation(known, iterations=2 * footage.unit)
    if not isinstance(scene, StaticScene) or same_place[mask].mean() < THERE:
        return False
    now, then = (scene.difference(k)[mask] for k in (i, prompted))
    told = np.isfinite(now) & np.isfinite(then)
    if not told.mean() > FEW:
        return False
    now, then = (np.minimum(v[told], 10).mean() for v in (now, then))
    return bool(now < FADED * then)


def _usual_size(
    area: Float[np.ndarray, " F"], proven: Bool[np.ndarray, " F"], given: list[int]
) -> Bool[np.ndarray, " F"]:
    """Frames in which the mask is about as large as in the proven ones around, or as prompted."""
    rows = np.flatnonzero(proven)
    fits = np.zeros(len(area), bool)
    for i in np.flatnonzero(area).tolist() if len(rows) else ():
        place = int(np.searchsorted(rows, i))
        usual = float(np.median(area[rows[max(0, place - AROUND) : place + AROUND + 1]]))
        fits[i] = SIZES[0] * usual <= area[i] <= SIZES[1] * usual
    fits[given] = True
    return fits


def _continued(
    masks: Bool[np.ndarray, "F h w"],
    agreement: Float[np.ndarray, " F"],
    given: list[int],
    bounds: Bounds,
    motions: Motions | None = None,
) -> Bool[np.ndarray, " F"]:
    """The proven frames, those that continue them, without those to which the object jumped.

    From each prompted frame outwards: a frame follows the last one that was believed if the object
    moved no farther than its motion so far foretells, or if enough frames were missed for it to
    have come there. Half proven ones are believed where they lead from a proven frame to another
    without a gap: a mask that drifts off the object never comes to one. Of others those are that
    motion leads to. The longer the object was not seen, the surer it must be: what is where it was
    looks like it more often than not.

    Args:
        motions: None: nothing is known of them.
    """
    found = np.zeros(len(masks), bool)
    found[given] = True
    place = np.array([center_of(m) if m.any() else (np.nan, np.nan) for m in masks])
    size = 2 * np.sqrt(masks.sum((1, 2)) / np.pi)

    def follows(i: int, last: int, speed: Float[np.ndarray, "2"]) -> bool:
        gap, way = abs(i - last), place[i] - place[last]
        off = min(np.hypot(*(way - speed * gap)), np.hypot(*way))
        again = min(bounds.proven + AGAIN * (gap - 1), bounds.again)
        least = bounds.carried if gap == 1 else again
        near = agreement[i] >= least and off <= STEP * max(size[i], size[last]) * gap
        return bool(near) and not (motions and motions.was_beside(i, last))

    def carried_on(start: int, end: int, step: int) -> list[int]:
        frames = range(start + step, end, step)
        alike = takewhile(lambda i: i not in given and agreement[i] >= bounds.moved, frames)
        return motions.carried_on(start, alike) if motions else []

    for start in given:
        for step in (1, -1):
            last, speed, half, kept = start, np.zeros(2), list[int](), list[int]()
            proven, end = (last, speed), len(masks) if step > 0 else -1
            for i in range(start + step, end, step):
                if i in given:
                    found[half] = True
                    break
                if i in kept:
                    continue
                # where looks end, once: what motion does not lead to from there, it never does
                if abs(i - last) == 1 and last not in kept and not follows(i, last, speed):
                    kept = carried_on(proven[0], end, step)
                    found[kept] = True
                    (last, speed), half = (kept[-1], np.zeros(2)) if kept else proven, []
                if i in kept or not follows(i, last, speed):
                    continue
                moved = place[i] - place[last]
                speed = 0.5 * (speed + moved) if abs(i - last) == 1 else np.zeros(2)
                last, half = i, [*half, i]
                if agreement[i] >= bounds.proven:
                    found[half] = True
                    proven, half = (last, speed), []
            else:
                if half:
                    found[carried_on(proven[0], end, step)] = True
    return found


@dataclass(frozen=True)
class Motions:
    """What the motion of a mask's own pixels says of other frames.

    Attributes:
        arrived: overlap of a proven mask that was moved on to a frame with the mask there.
    """

    footage: Footage
    masks: Bool[np.ndarray, "F h w"]
    arrived: dict[int, float] = field(default_factory=dict)
    _beside: dict[tuple[int, int], bool] = field(default_factory=dict)

    def carried_on(self, start: int, frames: Iterable[int]) -> list[int]:
        """How far the mask of a frame, moved on from frame to frame, agrees with the masks of the
        next ones. A mask that slides off the object does not move as the object's pixels do."""
        moved, last, found = self.masks[start], start, list[int]()
        for i in frames:
            moved, share, _ = moved_on(self.footage, last, i, moved)
            over = overlap(moved, self.masks[i])
            if share < SHARED or over < ARRIVES:
                break
            self.arrived[i], last = over, i
            found.append(i)
        return found

    def was_beside(self, i: int, j: int) -> bool:
        """Whether the mask of frame `i` shows what is seen in frame `j`, too, but beside the mask
        there: clothes or a hand that look like the object and move with the person."""
        if abs(i - j) > LONG or overlap(self.masks[i], self.masks[j]) > APART:
            return False
        if (i, j) not in self._beside:
            moved, _, differs = moved_on(self.footage, i, j, self.masks[i])
            beside = bool(moved.any()) and overlap(moved, self.masks[j]) < BESIDE
            self._beside[i, j] = beside and differs < SAME
        return self._beside[i, j]


def attached(
    proven: Bool[np.ndarray, " F"], given: Sequence[int], longest: int = LONG
) -> Bool[np.ndarray, " F"]:
    """The proven frames that proven ones lead to from a prompted one, without a longer gap: what
    was found again after that may be something that looks like the object."""
    rows, found = np.flatnonzero(proven), np.zeros(len(proven), bool)
    groups = np.split(rows, np.flatnonzero(np.diff(rows) > longest) + 1)
    for group in groups:
        found[group] = bool(np.isin(group, given).any())
    return found


def without_unproven(track: Track, proof: Proof, by_looks: bool = False) -> Track:
    """The track with empty masks in frames that are not believed; how sure the others are is how
    well the cues agree there, or how well the mask agrees with one that motion carried there.

    Args:
        by_looks: motion counts for nothing in how sure they are: another mask may be proven.
    """
    agreement = proof.agreement.copy()
    for i, share in () if by_looks else proof.arrived.items():
        agreement[i] = max(agreement[i], share)
    soft: UInt8[np.ndarray, "F h w"] = np.where(proof.proven[:, None, None], track.soft, 0)
    sure = np.where(proof.proven, np.minimum(agreement, np.maximum(track.confidence, 0.0)), 0)
    return Track(soft, sure)
