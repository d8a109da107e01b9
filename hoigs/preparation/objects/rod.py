"""Something long and thin that a hand holds, such as a club or a broom: a body of revolution.

Its masks show a line, and the body where the hand is on it. How far the line leads towards the
camera or away follows from how long it looks: of all frames the longest show it across the view.
Both ways look the same; of them the one is taken by which it turns least over the frames. Its turn
about its own axis cannot be seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor

from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.values.camera import Camera, pinhole_rays
from hoigs.core.values.clip import ObjectTrack
from hoigs.preparation.mask_stack import MaskStack, outlines_of
from hoigs.preparation.objects.alignment import Poses
from hoigs.preparation.objects.explained import outline_errors
from hoigs.preparation.objects.filmed import Filmed
from hoigs.preparation.objects.hands import HandMotion, hand_motion
from hoigs.preparation.objects.tracked import ObjectConfidence, between, palm_distances
from hoigs.preparation.objects.watched import FEWEST, UntrackableError

SLENDER = 0.1  # standard deviation of a mask across its axis, in those along it, median
HELD = 0.15  # metres in the image between the palm and the axis, median
BOTH = 0.25  # of the longer part: a shorter one on the other side of the hand
WHOLE = 0.9  # quantile of the lengths that counts as its own
PARTLY = 2  # frames on each side: what looks shorter than in these is hidden rather than turned
BUTT = 0.03  # metres that the hand covers of what ends there
THINNEST = 0.003  # metres, radius
SIDEWAYS = 0.6  # of its length that is seen across the view: frames that show its breadth
BINS = 24  # along the axis, in which its radius is measured


@dataclass(frozen=True)
class _Axis:
    """A mask's long axis in one frame.

    Attributes:
        middle, along: x, y of a point on it, and its direction, pixels. low, high: how far the mask
            reaches from the middle. slender: spread across it, in those along it.
    """

    middle: Float[np.ndarray, "2"]
    along: Float[np.ndarray, "2"]
    low: float
    high: float
    slender: float

    @classmethod
    def of(cls, mask: Bool[np.ndarray, "H W"]) -> _Axis:
        at = np.argwhere(mask)[:, ::-1] + 0.5
        middle = at.mean(0)
        spread, axes = np.linalg.eigh(np.cov((at - middle).T) + 1e-9 * np.eye(2))
        along = axes[:, 1]
        share = (at - middle) @ along
        slender = float((spread[0] / spread[1]) ** 0.5)
        return cls(middle, along, float(share.min()), float(share.max()), slender)


@dataclass(frozen=True)
class _Sights:
    """What frames show of the rod.

    Attributes:
        rows: the frames. grips: where the hand is on the axis, world, metres. views: unit
            directions from the camera to the grip. across: of the axis across the view, unit,
            towards the far end. lengths: from the grip to the far end across the view, metres.
            backs: to the other end, negative where that lies on the same side. metres: of a pixel.
        at, signs: where the grip is along each mask's axis, pixels, and 1 where the far end is
            that way, else -1.
    """

    rows: np.ndarray
    grips: Float[np.ndarray, "S 3"]
    views: Float[np.ndarray, "S 3"]
    across: Float[np.ndarray, "S 3"]
    lengths: Float[np.ndarray, " S"]
    backs: Float[np.ndarray, " S"]
    metres: Float[np.ndarray, " S"]
    at: Float[np.ndarray, " S"]
    signs: Float[np.ndarray, " S"]


def rod_object(
    filmed: Filmed, count: int
) -> tuple[ObjectTrack, Float[Tensor, "P 3"], float, ObjectConfidence]:
    """Poses and shape of a rod.

    Returns:
        the track (grey: colours are sampled afterwards), the points' outward normals, the part of
        its distance by which its middle is nearer or farther as it leads towards the camera or
        away, and how far the track may be trusted

    Raises:
        UntrackableError: its masks are not thin, or no hand is on it.
    """
    if filmed.joints is None:
        raise UntrackableError("nobody holds it")
    outlines = outlines_of(filmed.masks)
    rows = np.flatnonzero(outlines.observed)
    axes = [_Axis.of(filmed.masks[i]) for i in rows.tolist()]
    slender = float(np.median([axis.slender for axis in axes]))
    if len(rows) < FEWEST or slender > SLENDER:
        raise UntrackableError(
            f"its masks are {slender:.2f} times as broad as long in {len(rows)} frames "
            f"({SLENDER:g} at most, in {FEWEST} at least, for a rod)"
        )
    hands = hand_motion(filmed.joints, filmed.masks, outlines, filmed.cameras, filmed.fps)
    sights = _sights(rows, axes, filmed.cameras, hands)
    length = float(np.quantile(sights.lengths, WHOLE))
    back = float(np.quantile(sights.backs, WHOLE))
    back = back if back > BOTH * length else BUTT
    share = np.minimum(ndimage.maximum_filter1d(sights.lengths, 2 * PARTLY + 1) / length, 1.0)
    directions = _least_turned(sights, share)
    turns = torch.from_numpy(_carried(directions)).float()
    x, radii = _profile(filmed.masks, axes, sights, share, length, back)
    points, normals = _revolved(x, radii, count)
    middle = torch.tensor([(length - back) / 2, 0.0, 0.0])
    poses = Poses(turns, torch.from_numpy(sights.grips).float())
    rotations, places = between(poses, middle, outlines.observed, hands)
    points = points - middle
    away = np.median([float((c.center - p).norm()) for c, p in zip(filmed.cameras, places)])
    guessed = float(np.median(np.sqrt(1 - share**2))) * (length - back) / 2
    track = ObjectTrack(
        points=points,
        colors=torch.full_like(points, 0.5),
        rotations=rotations,
        translations=places,
        observed=torch.from_numpy(outlines.observed),
        provenance=(
            f"a rod of {length + back:.2f} m in a hand: its direction by its axis in "
            f"{len(rows)} of {len(outlines.observed)} frames, the others follow the hand; towards "
            "the camera or away is what turns least; its turn about its own axis is not known"
        ),
    )
    confidence = ObjectConfidence(
        "rod", np.full(len(rotations), np.nan), outline_errors(track, filmed),
        float(hands.held.mean()), float(hands.rests.mean()),
        palm_distances(hands, points, normals, rotations, places),
        "it was taken for a rod, whose turn about its own axis nothing shows; towards the camera "
        "or away is what turns least",
    )  # fmt: skip
    return track, normals, guessed / float(away), confidence


def breadth_of(masks: MaskStack) -> float:
    """Pixels across something long and thin, the median of the frames that show it."""
    axes = [(_Axis.of(mask), mask.sum()) for mask in masks if mask.sum() > 1]
    return float(np.median([area / (axis.high - axis.low) for axis, area in axes]))


def _sights(
    rows: np.ndarray, axes: Sequence[_Axis], cameras: Sequence[Camera], hands: HandMotion
) -> _Sights:
    """Raises:
    UntrackableError: no hand is on it.
    """
    palms, depths = _projected(hands.palms[rows], [cameras[i] for i in rows])
    focal = np.array([float(cameras[i].K[0, 0]) for i in rows])
    away = np.abs([
        [_cross(axis.along, palm - axis.middle) for palm in both]
        for axis, both in zip(axes, palms, strict=True)
    ])  # fmt: skip
    side = int(np.median(away * depths / focal[:, None], axis=0).argmin())
    off = float(np.median(away[:, side] * depths[:, side] / focal))
    if off > HELD:
        raise UntrackableError(f"no hand is on its axis: the nearest is {off:.2f} m beside it")
    palm, depth = palms[:, side], depths[:, side]
    at = np.array([(p - a.middle) @ a.along for p, a in zip(palm, axes, strict=True)])
    ends = np.array([(axis.low, axis.high) for axis in axes]) - at[:, None]
    signs = _far_end(ends, np.stack([axis.along for axis in axes]))
    along = signs[:, None] * np.stack([axis.along for axis in axes])
    grip = np.stack([a.middle + s * a.along for s, a in zip(at, axes, strict=True)])
    reach = np.where(signs > 0, ends[:, 1], -ends[:, 0])
    back = np.where(signs > 0, -ends[:, 0], ends[:, 1])
    places, views, across = [], [], []
    for i, x, z, way in zip(rows.tolist(), grip, depth, along, strict=True):
        camera = cameras[i]
        to_world = camera.world_to_camera[:3, :3].mT.double().numpy()
        ray, beside = (_ray(camera, pixel) for pixel in (x, x + way))
        places.append(camera.center.double().numpy() + to_world @ (ray * z))
        view = to_world @ ray / np.linalg.norm(ray)
        step = to_world @ (beside - ray)
        step -= (step @ view) * view
        views.append(view)
        across.append(step / np.linalg.norm(step))
    metres = depth / focal
    return _Sights(
        rows, np.stack(places), np.stack(views), np.stack(across), reach * metres, back * metres,
        metres, at, signs,
    )  # fmt: skip


def _projected(
    points: Float[np.ndarray, "S 2 3"], cameras: Sequence[Camera]
) -> tuple[Float[np.ndarray, "S 2 2"], Float[np.ndarray, "S 2"]]:
    """Pixels and depths of points, each frame by its camera."""
    seen = [c.project(torch.from_numpy(p).float()) for c, p in zip(cameras, points, strict=True)]
    return np.stack([xy.numpy() for xy, _ in seen]), np.stack([z.numpy() for _, z in seen])


def _ray(camera: Camera, pixel: Float[np.ndarray, "2"]) -> Float[np.ndarray, "3"]:
    """Direction through a pixel in the camera's axes, of depth 1."""
    return np.append(pinhole_rays(camera.K.double(), torch.from_numpy(pixel)[None])[0].numpy(), 1.0)


def _cross(a: Float[np.ndarray, "2"], b: Float[np.ndarray, "2"]) -> float:
    return float(a[0] * b[1] - a[1] * b[0])


def _far_end(
    ends: Float[np.ndarray, "S 2"], along: Float[np.ndarray, "S 2"]
) -> Float[np.ndarray, " S"]:
    """Of each frame, on which side of the hand the far end is, 1 or -1 along the axis: the longer
    side; where both are long, that which turns least from frame to frame."""
    longer = np.where(ends[:, 1] > -ends[:, 0], 1.0, -1.0)
    shorter = np.minimum(ends[:, 1], -ends[:, 0]) / np.abs(ends).max(1)
    if np.median(shorter) < BOTH:
        return longer
    start = int(np.argmin(shorter))  # where it is clearest
    signs = longer.copy()
    for rows in (range(start + 1, len(ends)), range(start - 1, -1, -1)):
        for i in rows:
            before = i - 1 if i > start else i + 1
            signs[i] = 1.0 if signs[before] * along[before] @ along[i] > 0 else -1.0
    return signs


def _least_turned(sights: _Sights, share: Float[np.ndarray, " S"]) -> Float[np.ndarray, "S 3"]:
    """Unit directions of the axis, of which `share` is seen across the view: of all choices
    between towards the camera and away the one of least turns."""
    depth = np.sqrt(1 - share**2)[:, None] * sights.views
    flat = share[:, None] * sights.across
    both = np.stack((flat - depth, flat + depth), 1)  # S, 2, 3
    cost, parents = np.zeros(2), []
    for i in range(1, len(both)):
        gap = sights.rows[i] - sights.rows[i - 1]
        turns = ((both[i, :, None] - both[i - 1, None]) ** 2).sum(-1) / gap
        total = cost[None] + turns
        parents.append(total.argmin(1))
        cost = total.min(1)
    chosen = [int(cost.argmin())]
    for parent in reversed(parents):
        chosen.append(int(parent[chosen[-1]]))
    return both[np.arange(len(both)), chosen[::-1]]


def _carried(directions: Float[np.ndarray, "S 3"]) -> Float[np.ndarray, "S 3 3"]:
    """Rotations that take x to each direction, from one to the next without a turn about it."""
    found, last = [], np.eye(3)
    for direction in directions:
        axis = np.cross(last[:, 0], direction)
        size = float(np.linalg.norm(axis))
        angle = np.arctan2(size, last[:, 0] @ direction)
        unit = axis / size if size > 1e-9 else last[:, 1]  # half a turn is about any axis across
        turn = axis_angle_to_matrices(torch.from_numpy(unit * angle))
        last = turn.numpy() @ last
        found.append(last)
    return np.stack(found)


def _profile(
    masks: MaskStack,
    axes: Sequence[_Axis],
    sights: _Sights,
    share: Float[np.ndarray, " S"],
    length: float,
    back: float,
) -> tuple[Float[np.ndarray, " B"], Float[np.ndarray, " B"]]:
    """Places along the axis from the grip, metres, and the rod's radius there: half of the median
    breadth of the masks."""
    edges = np.linspace(-back, length, BINS + 1)
    found = np.full((len(axes), BINS), np.nan)
    for row, axis in enumerate(axes):
        if share[row] < SIDEWAYS:
            continue
        at = np.argwhere(masks[int(sights.rows[row])])[:, ::-1] + 0.5
        metres = sights.metres[row]
        x = sights.signs[row] * ((at - axis.middle) @ axis.along - sights.at[row])
        number, _ = np.histogram(x * metres / share[row], edges)
        pixels = (edges[1] - edges[0]) * share[row] / metres  # that a bin is long
        found[row] = np.where(number > 0, number / pixels / 2 * metres, np.nan)
    known = np.isfinite(found).any(0)
    middles = (edges[:-1] + edges[1:]) / 2
    radii = np.interp(middles, middles[known], np.nanmedian(found[:, known], 0))
    return edges, np.maximum(radii, THINNEST)


def _revolved(
    edges: Float[np.ndarray, " E"], radii: Float[np.ndarray, " B"], count: int
) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
    """Points spread evenly over a body of revolution about x, and their outward normals."""
    area = np.append(0.0, np.cumsum(radii))
    x = np.interp((np.arange(count) + 0.5) / count * area[-1], area, edges)
    r = radii[np.searchsorted(edges, x).clip(1, len(radii)) - 1]
    turn = np.arange(count) * np.pi * (3 - 5**0.5)
    normals = np.stack((np.zeros(count), np.cos(turn), np.sin(turn)), -1)
    points = r[:, None] * normals + np.stack((x, 0 * x, 0 * x), -1)
    return torch.from_numpy(points).float(), torch.from_numpy(normals).float()
