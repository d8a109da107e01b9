"""An object's track from hands, outlines and texture together, and how far it may be trusted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hoigs.core.maths.rotations import matrices_to_quats, quats_to_matrices, slerp
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import ObjectTrack
from hoigs.preparation.mask_stack import Outlines
from hoigs.preparation.objects.alignment import (
    LEVELS,
    Aligned,
    Crops,
    Effort,
    Held,
    Level,
    Poses,
    Surface,
    align,
)
from hoigs.preparation.objects.hands import HandMotion
from hoigs.preparation.objects.search import flights_by_texture, grasps_by_texture
from hoigs.preparation.objects.shape import completed, hull, with_samples
from hoigs.preparation.objects.watched import FEWEST, UntrackableError, Watched

AGREES = 0.5  # correlation of textures from which a pose is trusted
SAMPLES = 1200


@dataclass(frozen=True)
class ObjectConfidence:
    """How far an object's track may be trusted.

    Attributes:
        way: "texture and hands", "outline", "rod" or "ball": how its poses were found.
        agreement: of each frame, correlation of its texture with that of the other frames; NaN
            where it does not show enough of it. Under `AGREES` its rotation is a guess.
        outline: of each frame, metres between the mask's outline and the shape's; NaN if not seen.
        held, rests: parts of the frames in which hands move it, and in which it rests.
        hand_distance: of each frame, metres from the nearest palm to the surface while held,
            negative inside; NaN while not held.
        reason: why the better way was not taken; empty if it was.
    """

    way: str
    agreement: Float[np.ndarray, " F"]
    outline: Float[np.ndarray, " F"]
    held: float = 0.0
    rests: float = 0.0
    hand_distance: Float[np.ndarray, " F"] = field(default_factory=lambda: np.zeros(0))
    reason: str = ""

    @staticmethod
    def none(way: str, frames: int, reason: str) -> ObjectConfidence:
        unknown = np.full(frames, np.nan)
        return ObjectConfidence(way, unknown, unknown, hand_distance=unknown, reason=reason)


def tracked_object(
    seen: Watched,
    count: int,
    progress: Callable[[float], None],
    levels: Sequence[Level] = LEVELS,
) -> tuple[ObjectTrack, Float[Tensor, "P 3"], ObjectConfidence]:
    """Poses and shape by `align`, started from the hands.

    Returns:
        the track (grey: colours are sampled afterwards), the points' outward normals, and how far
        it may be trusted.

    Raises:
        UntrackableError: textures do not agree.
    """
    outlines, hands, crops, radius = seen.outlines, seen.hands, seen.crops, seen.radius
    cameras, fps, shown = seen.filmed.cameras, seen.filmed.fps, outlines.observed
    start = _start(hands, outlines, cameras, shown)
    grasps = np.where(hands.near & hands.held[:, None], hands.pieces[:, None], -1)
    starts = np.diff(hands.rests.astype(int), prepend=0) == 1
    rests = np.where(hands.rests, np.cumsum(starts), -1)
    held = Held(
        torch.from_numpy(hands.palms[shown]).float(),
        torch.from_numpy(grasps[shown]),
        torch.from_numpy(rests[shown]),
    )
    known = _Known(crops, start, held, hands, radius, fps)
    surface, found = _aligned(known, levels, progress)
    agreement = over_frames(found.agreement, shown)
    typical = float(np.nanmedian(found.agreement)) if np.isfinite(found.agreement).any() else 0.0
    if typical < AGREES:
        raise UntrackableError(
            f"what the frames show of its texture agrees by {typical:.2f} only (correlation; "
            f"{AGREES} is needed): it has hardly any texture, is not rigid, or its masks are off"
        )
    vertices, depth = completed(crops, surface, found.poses, found.vertices, radius)
    found = replace(found, vertices=vertices)
    return _result(found, surface, hands, outlines, agreement, count, depth)


@dataclass(frozen=True)
class _Known:
    """What the alignment starts from; radius: metres within which the object lies."""

    crops: Crops
    start: Poses
    held: Held
    hands: HandMotion
    radius: float
    fps: float


def _aligned(
    known: _Known, levels: Sequence[Level], progress: Callable[[float], None]
) -> tuple[Surface, Aligned]:
    """One grasp first, with its rests; the other grasps by what it has shown; flights last, which
    give the shape nothing."""
    crops, start, hands, radius = known.crops, known.start, known.hands, known.radius
    tied, pieces = ~hands.free[crops.frames], hands.pieces[crops.frames]
    if tied.sum() < FEWEST:  # never held, never at rest: one piece, from no rotation at all
        tied, pieces = np.ones(len(crops), bool), np.zeros(len(crops), int)
    rows = np.flatnonzero(tied & (pieces == np.bincount(pieces[tied]).argmax()))
    later, flies = int(tied.sum()) > len(rows), not tied.all()
    steps = iter(range(1 + later + flies))

    def share(done: float, step: int = 0) -> None:
        progress((step + done) / (1 + later + flies))

    def aligned(rows: np.ndarray, poses: Poses, levels: Sequence[Level], shape: bool) -> Aligned:
        step = next(steps)
        return align(
            crops.rows(rows), surface, poses, known.held.rows(rows), known.fps,
            Effort(levels, shape, lambda done: share(done, step)),
        )  # fmt: skip

    surface = hull(crops.rows(rows), start.rows(rows), radius, SAMPLES)
    found = aligned(rows, start.rows(rows), levels, True)
    if later:
        rows = np.flatnonzero(tied)
        surface = replace(surface, rest=found.vertices)
        poses = grasps_by_texture(crops.rows(rows), surface, found, start.rows(rows), pieces[rows])
        found = aligned(rows, poses, levels[1:], True)
    if flies:
        rows, flying = np.arange(len(crops)), np.flatnonzero(~tied)
        surface = replace(surface, rest=found.vertices)
        poses = flights_by_texture(crops, surface, found, start, hands.up, known.fps)
        # a flight shows other sides: as many of its frames as of the others shape the hull
        others = np.flatnonzero(tied)[:: max(1, int(tied.sum()) // len(flying))]
        both = np.sort(np.concatenate((flying, others)))
        surface = hull(crops.rows(both), poses.rows(both), radius, SAMPLES)
        found = aligned(rows, poses, levels[1:], True)
    return surface, found


def _start(
    hands: HandMotion,
    outlines: Outlines,
    cameras: Sequence[Camera],
    shown: Bool[np.ndarray, " F"],
) -> Poses:
    pixels = torch.from_numpy(outlines.centers).float()
    places = [
        c.unproject(p, torch.tensor(float(z)))
        for c, p, z in zip(cameras, pixels, hands.depths, strict=True)
    ]
    return Poses(torch.from_numpy(hands.rotations[shown]).float(), torch.stack(places)[shown])


def over_frames(
    values: Float[np.ndarray, " C"], shown: Bool[np.ndarray, " F"]
) -> Float[np.ndarray, " F"]:
    found = np.full(len(shown), np.nan)
    found[shown] = values
    return found


def _result(
    found: Aligned,
    surface: Surface,
    hands: HandMotion,
    outlines: Outlines,
    agreement: Float[np.ndarray, " F"],
    count: int,
    depth: float | None,
) -> tuple[ObjectTrack, Float[Tensor, "P 3"], ObjectConfidence]:
    """Args:
    depth: metres, of an object whose back was never seen; None: it was.
    """
    back = "as small and smooth as the outlines allow"
    if depth is not None:
        back = (
            "as far from its middle as the side opposite, within the outlines: all frames show one "
            f"side, and it is taken to be {1000 * depth:.0f} mm deep, by the size of its outlines"
        )
    shown = outlines.observed
    dense = with_samples(found.vertices, surface.faces, count)
    points, normals = dense.points(found.vertices), dense.normals(found.vertices)
    middle = (points.max(0).values + points.min(0).values) / 2
    rotations, translations = between(found.poses, middle, shown, hands)
    points = points - middle
    distance = palm_distances(hands, points, normals, rotations, translations)
    known = np.isfinite(agreement) & (agreement >= AGREES)
    off = found.outline.mean()
    return (
        ObjectTrack(
            points=points,
            colors=torch.full_like(points, 0.5),
            rotations=rotations,
            translations=translations,
            observed=torch.from_numpy(shown),
            provenance=(
                f"texture, outlines and hands of all frames together: rotation known in "
                f"{int(known.sum())} of {len(shown)} frames, the others follow their neighbours; "
                f"distance from the hands that hold it ({int(hands.held.sum())} frames); shape "
                f"from outlines and texture, {1000 * off:.0f} mm off the masks' outlines, sides "
                f"never seen {back}"
            ),
        ),
        normals,
        ObjectConfidence(
            "texture and hands",
            agreement,
            over_frames(found.outline, shown),
            float(hands.held.mean()),
            float(hands.rests.mean()),
            distance,
        ),
    )


def between(
    poses: Poses, middle: Float[Tensor, " 3"], shown: Bool[np.ndarray, " F"], hands: HandMotion
) -> tuple[Float[Tensor, "F 3 3"], Float[Tensor, "F 3"]]:
    """Poses of all frames about the object's middle. Between two frames that show it, poses are
    interpolated: in the frame of the hands that hold it all the while, or else in the world."""
    rows = np.flatnonzero(shown)
    nearest = torch.from_numpy(np.searchsorted(rows, np.arange(len(shown))).clip(0, len(rows) - 1))
    rotations = poses.rotations[nearest]
    places = (poses.translations + poses.rotations @ middle)[nearest]
    rotations[rows[-1] :], places[rows[-1] :] = rotations[rows[-1]], places[rows[-1]]
    for first, last in zip(rows[:-1].tolist(), rows[1:].tolist(), strict=True):
        gap = np.arange(first, last + 1)
        turns, points = torch.eye(3).expand(len(gap), 3, 3), torch.zeros(len(gap), 3)
        holding = hands.near[gap].all(0) & hands.held[gap].all()
        if len(gap) > 2 and holding.any():
            turns = torch.from_numpy(hands.rotations[gap]).float()
            points = torch.from_numpy(hands.palms[gap][:, holding].mean(1)).float()
        ends, part = [0, -1], torch.linspace(0, 1, len(gap))[:, None]
        back = turns[ends].mT
        quats = matrices_to_quats(back @ rotations[gap[ends]])[:, None].expand(2, len(gap), 4)
        start, end = (back @ (places[gap[ends]] - points[ends])[..., None])[..., 0]
        rotations[gap] = turns @ quats_to_matrices(slerp(quats[0], quats[1], part))
        places[gap] = points + (turns @ torch.lerp(start, end, part)[..., None])[..., 0]
    return rotations, places


def palm_distances(
    hands: HandMotion,
    points: Float[Tensor, "P 3"],
    normals: Float[Tensor, "P 3"],
    rotations: Float[Tensor, "F 3 3"],
    translations: Float[Tensor, "F 3"],
) -> Float[np.ndarray, " F"]:
    """Of each frame, metres from the nearest palm that holds it to the surface, negative inside;
    NaN while not held."""
    found = np.full(len(rotations), np.nan)
    for i in np.flatnonzero(hands.held).tolist():
        palms = torch.from_numpy(hands.palms[i][hands.near[i]]).float()
        local = (palms - translations[i]) @ rotations[i]
        away = torch.cdist(local, points)
        nearest = away.argmin(-1)
        outwards = ((local - points[nearest]) * normals[nearest]).sum(-1)
        signed = away.gather(1, nearest[:, None])[:, 0] * outwards.sign()
        found[i] = float(signed.min())
    return found
