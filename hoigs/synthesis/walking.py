"""Walking: where the person is, which way it faces, and where each foot stands or swings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d

from hoigs.synthesis.kinematics import about

Array = np.ndarray
Y = np.array([0.0, 1.0, 0.0])
SIDES = (1.0, -1.0)  # left is +x
STANCE, TOE_OUT = 0.155, np.radians(12)  # ankles off the middle, metres; turn of each foot
BEHIND = -0.04  # of the ankles, metres along z
STRIDE = 0.9  # way of one cycle of both feet, metres
TURN_A_STRIDE = 2.8  # turn on the spot that takes one cycle, radians
STEP_HEIGHT = 0.07  # of a foot in mid-swing, metres
FINE = 1025  # samples of a walk, so that it does not depend on the number of frames


@dataclass(frozen=True)
class Walk:
    """The person's frame in the world, and its feet in that frame.

    Attributes:
        heading: turn about y, radians; 0 faces +z. place: of the person's axis, metres.
        spots: of the left and the right ankle, on the floor or lifted, in the person's frame.
        turns: of the feet about y, in the person's frame, radians.
    """

    heading: Float[Array, " F"]
    place: Float[Array, "F 3"]
    spots: tuple[Float[Array, "F 3"], Float[Array, "F 3"]]
    turns: tuple[Float[Array, " F"], Float[Array, " F"]]

    @property
    def rotations(self) -> Float[Array, "F 3 3"]:
        """Person to world."""
        return about(Y, self.heading)

    def to_world(self, points: Float[Array, "F 3"]) -> Float[Array, "F 3"]:
        """Points of the person's frame, one a frame, in the world."""
        return np.einsum("fij,fj->fi", self.rotations, points) + self.place

    def reach(self) -> Float[Array, " F"]:
        """How far, along the floor, the farther foot is from where it would stand, metres."""
        far = [
            np.hypot(spot[:, 0] - side * STANCE, spot[:, 2] - BEHIND)
            for spot, side in zip(self.spots, SIDES, strict=True)
        ]
        return np.maximum(*far)


def standing(frames: int) -> Walk:
    """Both feet planted at the origin, facing +z."""
    spots = [np.repeat([[side * STANCE, 0.0, BEHIND]], frames, 0) for side in SIDES]
    turns = [np.full(frames, side * TOE_OUT) for side in SIDES]
    return Walk(np.zeros(frames), np.zeros((frames, 3)), (spots[0], spots[1]), (turns[0], turns[1]))


def walking(
    frames: int, keys: Float[Array, "K 3"], length: float, centre: tuple[float, float]
) -> Walk:
    """A walk along a curve, in whole cycles of both feet, standing at the ends.

    Args:
        keys: rows (u, heading in degrees, share of the way done by then).
        length: of the whole way, metres.
        centre: (x, z) of the middle of the way's bounding box, metres.
    """
    fine = np.linspace(0, 1, FINE)
    heading, share = PchipInterpolator(keys[:, 0], keys[:, 1:])(fine).T
    heading = gaussian_filter1d(np.radians(heading), 18.0, mode="nearest")
    done = length * gaussian_filter1d(share, 18.0, mode="nearest")
    ahead = np.stack((np.sin(heading), np.zeros(FINE), np.cos(heading)), -1)
    steps = np.diff(done)[:, None] * (ahead[1:] + ahead[:-1]) / 2
    place = np.concatenate((np.zeros((1, 3)), steps.cumsum(0)))
    middle = (place.max(0) + place.min(0)) / 2
    place += np.array([centre[0] - middle[0], 0.0, centre[1] - middle[2]])
    path = np.column_stack((heading, place))
    phase = _phase(heading, done)
    at = np.linspace(0, 1, frames)
    walk = _sampled(path, fine, at)
    feet = [_foot(side, path, phase, np.interp(at, fine, phase), walk) for side in SIDES]
    (left, left_turn), (right, right_turn) = feet
    return Walk(walk[:, 0], walk[:, 1:], (left, right), (left_turn, right_turn))


def _phase(heading: Array, done: Array) -> Array:
    """Cycles of both feet so far; at whole numbers both feet are on the floor."""
    turned = np.concatenate(([0.0], np.abs(np.diff(heading)).cumsum()))
    phase = (done - done[0]) / STRIDE + turned / TURN_A_STRIDE
    return phase * max(1, round(phase[-1])) / phase[-1]


def _sampled(path: Array, at: Array, where: Array) -> Array:
    return np.stack([np.interp(where, at, column) for column in path.T], -1)


def _foot(
    side: float, path: Array, phase: Array, now: Array, walk: Array
) -> tuple[Float[Array, "F 3"], Float[Array, " F"]]:
    """One foot in the person's frame: it swings for half a cycle, then stands for half of one.

    It stands where it would be if the person stood there, as the body is in mid-stance.
    """
    own = now - (0.0 if side > 0 else 0.5)
    cycle = np.floor(own)
    swing = np.clip((own - cycle) / 0.5, 0, 1)
    eased = swing * swing * (3 - 2 * swing)
    late = now - own
    ends = []
    for plant in (cycle - 1, cycle):
        # the middle of the stance that follows this cycle's swing
        at = np.clip(plant + 0.75 + late, phase[0], phase[-1])
        body = _sampled(path, phase + 1e-9 * np.arange(len(phase)), at)
        turned = about(Y, body[:, 0])
        spot = turned @ np.array([side * STANCE, 0.0, BEHIND]) + body[:, 1:]
        ends.append(np.column_stack((spot, body[:, 0] + side * TOE_OUT)))
    world = ends[0] + eased[:, None] * (ends[1] - ends[0])
    moved = np.linalg.norm(ends[1] - ends[0], axis=-1)
    world[:, 1] += STEP_HEIGHT * np.minimum(moved / 0.3, 1) * np.sin(np.pi * swing) ** 2
    spot = np.einsum("fji,fj->fi", about(Y, walk[:, 0]), world[:, :3] - walk[:, 1:])
    return spot, world[:, 3] - walk[:, 0]
