"""Which masks of a track are proven to show the object, and where it is in the other frames.

A tracker always finds something. Its mask is believed where the looks that were learnt in other
frames and the nearest of the cells known there agree that it is the object, where its size is one
that the object has about then, where it does not lie on what was there while the object was
elsewhere, and where it did not jump. All other masks are dropped: none is better than a wrong one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage
from torch import Tensor

from hoigs.plugins.estimators.object_tracker.appearance import (
    FREE,
    Appearance,
    cell_features,
    cell_shares,
)
from hoigs.plugins.estimators.object_tracker.footage import Footage
from hoigs.plugins.estimators.object_tracker.path import center_of
from hoigs.plugins.estimators.object_tracker.prompts import (
    OF_PERSON,
    PromptedMask,
    lies_on_people,
    of_person,
)
from hoigs.plugins.estimators.object_tracker.propagation import Track
from hoigs.plugins.estimators.object_tracker.scene import Scene, StaticScene, carried

PROVEN = 0.5  # agreement from which a mask is proven by itself
CARRIED = 0.3  # and from which it is by the frames beside it, from which it does not differ much
SIZES = (0.3, 1.5)  # of its usual area about then: half hidden, and not with a thing beside it
AROUND = 6  # proven frames before and after a frame that say what is usual
STEP = 1.5  # diameters a frame beside what the motion foretells: farther is a jump
# of an object that has twins: how far beside its way it may be, in breadths; its area, of that
# before; in distances of the nearest other; and frames that may be missed
BESIDE, ALONE, CLEARLY, MISSED = 0.6, (0.6, 1.4), 0.5, 8
SAME = 6.0  # units of colour within which a place looks as it did
THERE = 0.7  # share of a mask that looks as it did while the object was elsewhere
FEW, FADED = 0.3, 0.5  # of a mask: share before a known scene, and of its difference from it then
MORE = 0.15  # how much more a mask on people has of their colours than the clicked one
BANK = 4000  # cells of other things that are compared with


@dataclass(frozen=True)
class Known:
    """Masks of the object in some frames, and pixels of these that look like it and are not."""

    masks: Mapping[int, Bool[np.ndarray, "h w"]]
    twins: Mapping[int, Bool[np.ndarray, "h w"]]

    def others(self, i: int) -> Bool[np.ndarray, "h w"]:
        """Pixels of a frame that show something else, and do not look like the object."""
        return ~(self.masks[i] | self.twins.get(i, False))


@dataclass(frozen=True)
class Proof:
    """What speaks for the masks of a track.

    Attributes:
        agreement: of each frame, the lesser of the mean probability of its mask's cells by the
            looks, and of the share of them that is nearer to a known cell of the object than to one
            of anything else; 0 where the mask is empty. proven: the frames that are believed.
    """

    agreement: Float[np.ndarray, " F"]
    proven: Bool[np.ndarray, " F"]


def proof_of(
    footage: Footage,
    scene: Scene,
    prompts: Sequence[PromptedMask],
    track: Track,
    looks: Appearance,
    known: Known,
) -> Proof:
    """The frames whose mask shows what was prompted.

    Args:
        looks: learnt from the `known` masks: those of the prompted frames, and perhaps of further
            ones that are proven.
    """
    masks = track.soft > 127
    given = [p.frame for p in prompts]
    bank = _Bank.of(footage, looks, known)
    agreement = np.array([_agreement(bank, looks, i, m) for i, m in enumerate(masks)])
    agreement[given] = 1.0
    most = max(OF_PERSON, MORE + max(of_person(footage, i, known.masks[i]) for i in given))
    for i in np.flatnonzero(agreement >= CARRIED).tolist():
        if i not in given and (
            _was_there(footage, scene, known, given, i, masks[i])
            or lies_on_people(footage, i, masks[i], most)
        ):
            agreement[i] = 0.0
    area = masks.sum((1, 2)).astype(float)
    agreement[~_usual_size(area, agreement >= PROVEN, given)] = 0.0
    proven = agreement >= PROVEN
    if not known.twins:
        return Proof(agreement, _continued(masks, agreement, proven, given))

    def alike(i: int) -> Float[np.ndarray, "N 2"]:
        return _middles_of_alike(looks, i, masks[i], masks[given[0]].sum())

    return Proof(agreement, _followed(masks, agreement, alike, given))


def _middles_of_alike(
    looks: Appearance, i: int, mask: Bool[np.ndarray, "h w"], usual: float
) -> Float[np.ndarray, "N 2"]:
    """Middles x, y of what looks like the object beside its mask, and is no small part of one."""
    own = ndimage.binary_dilation(mask, iterations=2 * looks.side)
    labels, count = ndimage.label((looks.odds(i) > 0) & ~own)
    rows = np.arange(1, count + 1)
    large = rows[ndimage.sum_labels(np.ones(mask.shape), labels, rows) > SIZES[0] * usual]
    middles = ndimage.center_of_mass(labels > 0, labels, large)
    return np.array(middles).reshape(-1, 2)[:, ::-1] + 0.5


@dataclass(frozen=True)
class _Bank:
    """Features of known cells: the object's, and those of all else."""

    inside: Float[Tensor, "N C"]
    outside: Float[Tensor, "M C"]

    @classmethod
    def of(cls, footage: Footage, looks: Appearance, known: Known) -> _Bank:
        inside, outside = [], []
        for i, mask in known.masks.items():
            cells = looks.scaled(cell_features(footage.colors(i), looks.side))
            share = torch.from_numpy(cell_shares(mask, looks.side).ravel())
            inside.append(cells[share > 0.5])
            free = torch.from_numpy(cell_shares(known.others(i), looks.side).ravel())
            rest = cells[free > 1 - FREE]
            outside.append(rest[:: max(1, len(known.masks) * len(rest) // BANK)])
        return cls(torch.cat(inside), torch.cat(outside))

    def nearer(self, cells: Float[Tensor, "K C"]) -> float:
        """The share of cells that are nearer to one of the object's."""
        if not len(self.inside) or not len(self.outside):
            return 0.0
        near, far = (torch.cdist(cells, b).min(1).values for b in (self.inside, self.outside))
        return float((near < far).float().mean())


def _agreement(bank: _Bank, looks: Appearance, i: int, mask: Bool[np.ndarray, "h w"]) -> float:
    share = cell_shares(mask, looks.side)
    inside = share > min(0.6, 0.9 * share.max())
    if not mask.any() or not inside.any():
        return 0.0
    odds = looks.cells(i)[inside]
    cells = looks.scaled(cell_features(looks.footage.colors(i), looks.side))
    alike = float((1 / (1 + np.exp(-odds))).mean())
    return min(alike, bank.nearer(cells[torch.from_numpy(inside.ravel())]))


def _was_there(
    footage: Footage,
    scene: Scene,
    known: Known,
    given: Sequence[int],
    i: int,
    mask: Bool[np.ndarray, "h w"],
) -> bool:
    """Whether a place looks as it did in a frame in which the object is known to be elsewhere, or
    as the still scene does, from which the object differed when it was there."""
    y, x = np.nonzero(mask)
    here = footage.colors(i)[y, x]
    for frame in given:
        to = np.floor(carried(scene, np.stack((x, y), -1) + 0.5, i, frame)).astype(int)
        inside = ((to >= 0) & (to < np.array(footage.shape[::-1]))).all(1)
        row, column = to[inside].T[::-1]
        elsewhere = (known.others(frame) & ~footage.blank[frame])[row, column]
        if not len(row):
            continue
        if elsewhere.mean() >= THERE:
            away = np.abs(here[inside] - footage.colors(frame)[row, column]).max(1)
            if (away[elsewhere] < SAME).mean() > THERE:
                return True
        same_place = ndimage.binary_dilation(known.masks[frame], iterations=2 * footage.unit)
        if isinstance(scene, StaticScene) and same_place[mask].mean() >= THERE:
            now, then = (scene.difference(k)[mask] for k in (i, frame))
            told = np.isfinite(now) & np.isfinite(then)
            if told.mean() > FEW:
                now, then = (np.minimum(v[told], 10).mean() for v in (now, then))
                if now < FADED * then:
                    return True
    return False


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
    proven: Bool[np.ndarray, " F"],
    given: list[int],
) -> Bool[np.ndarray, " F"]:
    """The proven frames, those that continue them, without those to which the object jumped.

    From each prompted frame outwards: a frame follows the last one that was believed if the object
    moved no farther than its motion so far foretells, or if enough frames were missed for it to
    have come there; one that is half proven follows only the frame beside it.
    """
    found = np.zeros(len(masks), bool)
    found[given] = True
    place = np.array([center_of(m) if m.any() else (np.nan, np.nan) for m in masks])
    size = 2 * np.sqrt(masks.sum((1, 2)) / np.pi)
    for start in given:
        for step in (1, -1):
            last, speed = start, np.zeros(2)
            for i in range(start + step, len(masks) if step > 0 else -1, step):
                if i in given:
                    break
                gap = abs(i - last)
                off = np.hypot(*(place[i] - place[last] - speed * gap))
                off = min(off, np.hypot(*(place[i] - place[last])))
                reach = STEP * max(size[i], size[last]) * gap
                enough = proven[i] or (gap == 1 and agreement[i] >= CARRIED)
                if not enough or not off <= reach:
                    continue
                moved = place[i] - place[last]
                speed = 0.5 * (speed + moved) if gap == 1 else np.zeros(2)
                found[i], last = True, i
    return found


def _followed(
    masks: Bool[np.ndarray, "F h w"],
    agreement: Float[np.ndarray, " F"],
    alike: Callable[[int], Float[np.ndarray, "N 2"]],
    given: list[int],
) -> Bool[np.ndarray, " F"]:
    """Of an object that has twins: the frames in which its way tells which of them is seen.

    Looks do not tell. A mask is the object's where it lies on its way, and clearly nearer to that
    than any other thing that looks alike. A few frames may be missed, as a hand may cover it; once
    another thing comes to where it was last seen meanwhile, or too many are missed, nothing tells
    any more which is which.

    Args:
        alike: of a frame, the middles x, y of things beside its mask that look like the object.
    """
    found = np.zeros(len(masks), bool)
    found[given] = True
    area = masks.sum((1, 2)).astype(float)
    for start in given:
        for step in (1, -1):
            at, speed, usual, last = (
                np.array(center_of(masks[start])),
                np.zeros(2),
                area[start],
                start,
            )
            for i in range(start + step, len(masks) if step > 0 else -1, step):
                gap = abs(i - last)
                if i in given or gap > MISSED:
                    break
                breadth = np.sqrt(usual)
                fits = agreement[i] >= CARRIED and ALONE[0] < area[i] / usual < ALONE[1]
                foretold = at + speed if gap == 1 else at  # nothing goes on evenly behind a hand
                others = np.hypot(*(alike(i) - foretold).T).min(initial=np.inf)
                if fits:
                    moved = np.array(center_of(masks[i])) - at
                    off = np.hypot(*(moved + at - foretold))
                    if off <= min(BESIDE * breadth, CLEARLY * others):
                        at, speed, last = (
                            at + moved,
                            0.5 * (speed + moved) if gap == 1 else 0 * at,
                            i,
                        )
                        usual = 0.9 * usual + 0.1 * area[i]
                        found[i] = True
                        continue
                if others < breadth or area[i] >= ALONE[1] * usual:
                    break  # another thing is there, or was taken in
    return found


def without_unproven(track: Track, proof: Proof) -> Track:
    """The track with empty masks in frames that are not believed; how sure the others are is how
    well the cues agree there."""
    soft: UInt8[np.ndarray, "F h w"] = np.where(proof.proven[:, None, None], track.soft, 0)
    sure = np.where(proof.proven, np.minimum(proof.agreement, np.maximum(track.confidence, 0.0)), 0)
    return Track(soft, sure)
