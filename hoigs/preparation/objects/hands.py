"""When hands hold an object, and the poses that this gives it: it turns and moves with them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor

from hoigs.core.interfaces.body import LEFT_WRIST, RIGHT_WRIST
from hoigs.core.maths.frame_times import fill_gaps, smooth
from hoigs.core.values.camera import Camera
from hoigs.preparation.mask_stack import MaskStack, Outlines
from hoigs.preparation.objects.shape import hand_depths

# When an object rests, by the middle of its mask.

STILL = 0.07  # metres a second: an object that moves less rests
SHORTEST = 0.2  # seconds of a grasp or a rest
STAYS = 0.4  # seconds for which an object with a hand at it has to keep its place to rest


def resting(
    outlines: Outlines,
    depths: Float[np.ndarray, " F"],
    cameras: Sequence[Camera],
    fps: float,
    near: Bool[np.ndarray, " F"],
) -> Bool[np.ndarray, " F"]:
    """Frames in which the mask's middle moves in the image as a point that stands still in the
    world does; with a hand near it only as part of a rest that is certain by its length (`_stays`).

    Args:
        depths: of the object along the view, about, metres. near: frames with a hand at it.
    """
    # frames that have the mask's middle where it was, or will be, a moment apart
    count, step = len(cameras), max(1, round(SHORTEST * fps / 2))
    speed = np.full(count, np.inf)
    for i in range(count):
        others = [j for j in (i - step, i + step) if 0 <= j < count]
        rows = [j for j in others if outlines.whole[i] and outlines.whole[j]]
        speed[i] = min(_moved(outlines, depths, cameras, i, rows), default=np.inf) * fps / step
    still = speed < STILL
    runs, _ = ndimage.label(still)
    sure = np.unique(runs[_stays(outlines, depths, cameras, fps)])
    still &= ~near | np.isin(runs, sure)
    return cleaned(still[:, None], fps)[:, 0]


def cleaned(flags: Bool[np.ndarray, "F N"], fps: float) -> Bool[np.ndarray, "F N"]:
    """Without runs and gaps shorter than `SHORTEST`."""
    structure = np.ones((max(1, round(SHORTEST * fps)), 1), dtype=bool)
    padded = np.pad(flags, ((len(structure), len(structure)), (0, 0)), mode="edge")
    closed = ndimage.binary_closing(padded, structure)
    opened = ndimage.binary_opening(closed, structure)
    return opened[len(structure) : -len(structure)]


def _stays(
    outlines: Outlines,
    depths: Float[np.ndarray, " F"],
    cameras: Sequence[Camera],
    fps: float,
) -> Bool[np.ndarray, " F"]:
    """Frames of spans of `STAYS` seconds in which the mask's middle keeps to one still point.

    That it is where it was a moment ago may be chance with a hand that moves it: one that moves
    towards the camera, turns back or is only just set in motion.
    """
    count, span = len(cameras), max(3, round(STAYS * fps))
    stays = np.zeros(count, dtype=bool)
    for first in range(count - span + 1):
        rows = list(range(first, first + span))
        if outlines.whole[rows].all():
            moved = _moved(outlines, depths, cameras, rows[span // 2], rows)
            stays[rows] |= max(moved) < STILL * STAYS / 2
    return stays


def _moved(
    outlines: Outlines,
    depths: Float[np.ndarray, " F"],
    cameras: Sequence[Camera],
    start: int,
    rows: Sequence[int],
) -> list[float]:
    """Metres across the view, in some frames, from where the middle of a frame's mask would be had
    it stood still."""
    pixel = torch.tensor(outlines.centers[start], dtype=torch.float32)
    point = cameras[start].unproject(pixel, torch.tensor(float(depths[start])))
    metres = []
    for i in rows:
        xy, depth = cameras[i].project(point[None])
        pixels = float(np.linalg.norm(xy[0].numpy() - outlines.centers[i]))
        metres.append(pixels * float(depth[0]) / float(cameras[i].K[0, 0]))
    return metres


HAND_JOINTS = 30  # the last joints of a body: fifteen of each hand, three a finger, index first
MIDDLE, INDEX, LITTLE = 3, 0, 6  # first joints of these fingers within a hand
FEET = (7, 8, 10, 11)  # ankles and balls of the feet
MASS = {0: 0.4, 9: 0.3, 16: 0.15, 17: 0.15}  # about: pelvis, chest, shoulders; the centre of mass
UPRIGHT = 0.25  # of the frames: those in which the body stands straightest
REACH = 0.13  # metres in the image between a palm and what it holds
HIDDEN = 0.6  # of the median area of its masks: under this most of the object is hidden
RELEASE = 0.12  # seconds for which hands are near what they have let go
STEADY = 0.45  # seconds over which the distance of the nearest wrist is smoothed
ALONG = 5  # points of a bone


@dataclass(frozen=True)
class HandMotion:
    """What the hands say of the object.

    Attributes:
        held: frames in which a hand is at the object and it moves. rests: it does not move.
        rotations: of the frame that the hands span, turned so that it never jumps between frames
            that follow each other in a grasp or a rest; constant while the object rests.
        depths: of the hands along the view, metres, interpolated where they do not hold it.
        palms: left and right, world, metres. near: which of them are at the object.
        up: against gravity, unit, world: from the feet to the centre of mass, where the body
            stands straightest.
        pieces: number of each frame's piece: within one the rotations are known against each
            other, between two they are not (a flight lies between them).
        anybody: there are hands; without them nothing is thrown, and what moves is one piece.
    """

    held: Bool[np.ndarray, " F"]
    rests: Bool[np.ndarray, " F"]
    rotations: Float[np.ndarray, "F 3 3"]
    depths: Float[np.ndarray, " F"]
    palms: Float[np.ndarray, "F 2 3"]
    near: Bool[np.ndarray, "F 2"]
    pieces: np.ndarray
    up: Float[np.ndarray, " 3"]
    anybody: bool = True

    @property
    def free(self) -> Bool[np.ndarray, " F"]:
        """Frames in which it flies: it neither rests nor is held, in a clip with hands."""
        return ~(self.held | self.rests) & self.anybody


def hand_motion(
    joints: Float[Tensor, "F J 3"],
    masks: MaskStack,
    outlines: Outlines,
    cameras: Sequence[Camera],
    fps: float,
) -> HandMotion:
    """Grasps and rests of the object, and the frame that the hands span.

    A hand is at the object where its palm is within `REACH` of the mask, measured in the image at
    the palm's depth. When it rests, see `resting`.
    """
    window = max(5, round(STEADY * fps) | 1)
    places = joints.double().numpy()
    first = places.shape[1] - HAND_JOINTS
    wrists = places[:, [LEFT_WRIST, RIGHT_WRIST]]
    middle = places[:, [first + MIDDLE, first + HAND_JOINTS // 2 + MIDDLE]]
    palms = (wrists + middle) / 2
    away = _palm_distances(palms, masks, cameras)
    near = _kept_while_hidden(cleaned(away < REACH, fps), outlines)
    depths = hand_depths(masks, cameras, joints[:, [LEFT_WRIST, RIGHT_WRIST]])
    depths = smooth(depths, window)
    rests = resting(outlines, depths, cameras, fps, np.asarray(near.any(1)))
    held = near.any(1) & ~rests
    # hands are still, or already, near for a moment while it flies
    flies = ndimage.binary_dilation(~(held | rests), iterations=max(1, round(RELEASE * fps)))
    held = np.asarray(held & ~flies)
    frames = _hand_frames(places, near, first)
    rotations, pieces = _chained(frames, near, held, rests)
    known = np.asarray(near.any(1))
    palm_depths = _depths_of(palms, near, depths, cameras)
    if known.any():
        depths = fill_gaps(palm_depths, known)
    return HandMotion(held, rests, rotations, depths, palms, near, pieces, upward(places))


def no_hands(
    outlines: Outlines, depths: Float[np.ndarray, " F"], cameras: Sequence[Camera], fps: float
) -> HandMotion:
    """Of an object in a clip without people, at supposed depths along the view, metres."""
    count = len(depths)
    rests = resting(outlines, depths, cameras, fps, np.zeros(count, bool))
    if not rests.all():  # a thing that turns on its spot rests by its middle
        rests = np.zeros_like(rests)
    nothing = np.zeros((count, 2, 3))
    return HandMotion(
        np.zeros(count, bool), rests, np.tile(np.eye(3), (count, 1, 1)), depths, nothing,
        np.zeros((count, 2), bool), np.zeros(count, int), np.array((0.0, -1.0, 0.0)), False,
    )  # fmt: skip


def nearest_person(
    joints: Mapping[str, Float[Tensor, "F J 3"]], masks: MaskStack, cameras: Sequence[Camera]
) -> str | None:
    """Name of the one whose wrist is nearest to an object in most frames; None without people."""
    if len(joints) < 2:
        return next(iter(joints), None)
    wrists = {
        name: places[:, [LEFT_WRIST, RIGHT_WRIST]].double().numpy()
        for name, places in joints.items()
    }
    away = np.stack([_palm_distances(p, masks, cameras).min(1) for p in wrists.values()])
    seen = np.isfinite(away).any(0)
    if not seen.any():
        return next(iter(joints))
    return list(joints)[int(np.bincount(away[:, seen].argmin(0)).argmax())]


def along_bones(joints: Float[Tensor, "F J 3"], parents: Sequence[int]) -> Float[Tensor, "F B 3"]:
    """Points along the body's bones, world."""
    import torch

    child = torch.tensor([j for j, parent in enumerate(parents) if parent >= 0])
    parent = torch.tensor(parents)[child]
    parts = torch.linspace(0, 1, ALONG)[:, None]
    bones = torch.lerp(joints[:, parent, None], joints[:, child, None], parts)
    return bones.flatten(1, 2)


def upward(places: Float[np.ndarray, "F J 3"]) -> Float[np.ndarray, " 3"]:
    """From the middle of the feet to the centre of mass, which balance keeps above it."""
    mass = np.einsum("j,fjc->fc", np.array(list(MASS.values())), places[:, list(MASS)])
    body = mass - places[:, list(FEET)].mean(1)
    tall = np.linalg.norm(body, axis=-1)
    up = body[tall >= np.quantile(tall, 1 - UPRIGHT)].mean(0)
    return up / max(float(np.linalg.norm(up)), 1e-9)


def _palm_distances(
    palms: Float[np.ndarray, "F 2 3"], masks: MaskStack, cameras: Sequence[Camera]
) -> Float[np.ndarray, "F 2"]:
    """Metres in the image from each palm to the mask; infinite where there is none."""
    import torch

    away = np.full((len(masks), 2), np.inf)
    for i, (mask, camera) in enumerate(zip(masks, cameras, strict=True)):
        xy, depth = camera.project(torch.from_numpy(palms[i]).float())
        if not mask.any() or bool((depth <= 0).any()):
            continue
        # the mask may be cut by the hands themselves: outside is measured from its filled outline
        rows, columns = np.nonzero(mask & ~ndimage.binary_erosion(mask))
        edge = np.stack((columns, rows), -1) + 0.5
        pixels = np.linalg.norm(xy.numpy()[:, None] - edge[None], axis=-1).min(1)
        column, row = np.clip(xy.numpy().astype(int), 0, [mask.shape[1] - 1, mask.shape[0] - 1]).T
        pixels[mask[row, column]] = 0
        away[i] = pixels * depth.numpy() / float(camera.K[0, 0])
    return away


def _kept_while_hidden(
    near: Bool[np.ndarray, "F 2"], outlines: Outlines
) -> Bool[np.ndarray, "F 2"]:
    """A hand that is at the object before and after most of it is hidden is so meanwhile."""
    hidden = ~(outlines.areas >= HIDDEN * np.median(outlines.areas[outlines.observed]))
    labels, count = ndimage.label(hidden)
    kept = near.copy()
    for run in range(1, count + 1):
        rows = np.flatnonzero(labels == run)
        if rows[0] > 0 and rows[-1] + 1 < len(near):
            kept[rows] |= near[rows[0] - 1] & near[rows[-1] + 1]
    return kept


def _hand_frames(
    places: Float[np.ndarray, "F J 3"], near: Bool[np.ndarray, "F 2"], first: int
) -> dict[tuple[bool, bool], Float[np.ndarray, "F 3 3"]]:
    """Frames spanned by both hands, by the left and by the right one."""
    wrists = places[:, [LEFT_WRIST, RIGHT_WRIST]]
    fingers = [
        places[:, [first + f, first + HAND_JOINTS // 2 + f]] for f in (MIDDLE, INDEX, LITTLE)
    ]
    forward = fingers[0] - wrists
    across = fingers[2] - fingers[1]
    return {
        (True, True): _frame(wrists[:, 1] - wrists[:, 0], forward.sum(1)),
        (True, False): _frame(forward[:, 0], across[:, 0]),
        (False, True): _frame(forward[:, 1], across[:, 1]),
    }


def _frame(x: Float[np.ndarray, "F 3"], y: Float[np.ndarray, "F 3"]) -> Float[np.ndarray, "F 3 3"]:
    """Rotations whose first axis is x, and whose second lies towards y."""
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    z = np.cross(x, y)
    z = z / np.maximum(np.linalg.norm(z, axis=-1, keepdims=True), 1e-9)
    return np.stack((x, np.cross(z, x), z), -1)


def _chained(
    frames: dict[tuple[bool, bool], Float[np.ndarray, "F 3 3"]],
    near: Bool[np.ndarray, "F 2"],
    held: Bool[np.ndarray, " F"],
    rests: Bool[np.ndarray, " F"],
) -> tuple[Float[np.ndarray, "F 3 3"], np.ndarray]:
    """The turns of the hands while they hold it, one after another; none while it rests."""
    count = len(held)
    rotations, pieces = np.tile(np.eye(3), (count, 1, 1)), np.zeros(count, int)
    for i in range(1, count):
        both = held[i] and held[i - 1]
        hands = tuple((near[i] & near[i - 1]).tolist()) if both else (False, False)
        turn = np.eye(3)
        if hands in frames:
            turn = frames[hands][i] @ frames[hands][i - 1].T
        rotations[i] = turn @ rotations[i - 1]
        known = held[i] or rests[i]
        pieces[i] = pieces[i - 1] + int(known and not (held[i - 1] or rests[i - 1]))
    return rotations, pieces


def _depths_of(
    palms: Float[np.ndarray, "F 2 3"],
    near: Bool[np.ndarray, "F 2"],
    otherwise: Float[np.ndarray, " F"],
    cameras: Sequence[Camera],
) -> Float[np.ndarray, " F"]:
    """Mean depth of the palms at the object."""
    import torch

    depths = otherwise.copy()
    for i, camera in enumerate(cameras):
        if near[i].any():
            points = torch.from_numpy(palms[i][near[i]]).float()
            depths[i] = float(camera.to_camera(points)[:, 2].mean())
    return depths
