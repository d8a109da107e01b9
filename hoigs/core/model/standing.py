"""Up and floor of a world from the people in it: who stands is upright, and feet at rest are on
the floor.

Two estimates are joined. The body: from the middle of the feet to the centre of mass, which balance
keeps above them, while legs and trunk are straight. The floor: ankles of feet at rest are all at
one height. It needs feet that stood in several places, and then is the better of the two.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float

from hoigs.core.interfaces.body import BodyModel
from hoigs.core.values.clip import Clip
from hoigs.core.values.moment import BodyPose
from hoigs.core.values.world import World

MOST_FRAMES = 400  # evenly chosen; more tell no more
CHUNK = 32  # frames posed at a time
LEGS = ((1, 4, 7), (2, 5, 8))  # hip, knee, ankle
NECK, ANKLES, FEET = 12, (7, 8), (7, 8, 10, 11)  # feet: ankles and balls
MASS = {0: 0.4, 9: 0.3, 16: 0.15, 17: 0.15}  # about: pelvis, chest, shoulders; the centre of mass
STRAIGHT = 0.93  # from ankles to neck, over the lengths of shin, thigh and trunk
STANDING = 0.05  # of the frames, at least two; in fewer nobody stands
RESTS = 0.15  # metres a second: an ankle slower than this is at rest
SAME = 0.1  # metres: a foot that rested nearer than this to an earlier place tells nothing new
OFF_BODY = 0.07  # radians: how far the body's mean up is off
OFF_FLOOR = 0.03  # metres: how far a resting ankle is from its usual height
NINE_OF_TEN = 1.645  # standard deviations
ROUNDS = 10  # of the weighted least squares

Array = np.ndarray


def world_of_people(
    people: Sequence[tuple[BodyModel, BodyPose]], fps: float, *, metres: bool = True
) -> World | None:
    """The world in which these people stand; None if nobody ever stands upright.

    Args:
        people: the body model of each and its poses, batched over the frames.
        fps: frames a second.
        metres: of the world, see there.
    """
    upright: list[Array] = []  # a direction for each frame in which somebody stands
    rested: list[Array] = []  # places of ankles at rest
    lowest: list[tuple[Array, Array]] = []  # joints and the vertices that may be the lowest
    for body, poses in people:
        count = len(poses.transl)
        stride = -(-count // MOST_FRAMES)
        rows = list(range(0, count, stride))
        joints = np.concatenate([j for j, _ in _posed(body, poses, rows)])
        stands = standing(joints)
        if stands.sum() < max(2, STANDING * len(rows)):
            continue
        upright.append(_from_feet(joints[stands]))
        rests = _resting(joints[:, ANKLES], fps / stride) & stands[:, None]
        for foot, ankle in enumerate(ANKLES):
            rested.append(_places(joints[rests[:, foot], ankle]))
        still = np.flatnonzero(rests.any(1)) if rests.any() else np.flatnonzero(stands)
        some = still[np.linspace(0, len(still) - 1, min(len(still), CHUNK)).astype(int)]
        lowest += _posed(body, poses, [rows[i] for i in some])
    if not upright:
        return None
    body_up = _unit(np.concatenate(upright).mean(0))
    up, sure, within = _joined(body_up, np.concatenate(rested))
    heights = np.concatenate([(vertices @ up).min(1) for _, vertices in lowest])
    x, y, z = up.tolist()
    floor = float(np.median(heights))
    return World((x, y, z), floor, metres, "floor" if sure else "body", within)


def in_known_world(clip: Clip, bodies: Mapping[str, BodyModel]) -> Clip:
    """The clip, with `world_of_people` where its world is a guess and they know better.

    Args:
        bodies: the models of its people, by entity; those of others are not asked.
    """
    if not clip.world.is_guess:
        return clip
    people = [(bodies[n], track.poses) for n, track in clip.bodies.items() if n in bodies]
    found = world_of_people(people, clip.fps, metres=clip.world.metres)
    return clip if found is None else replace(clip, world=found)


def standing(joints: Float[Array, "F J 3"]) -> Bool[Array, " F"]:
    """Frames in which legs and trunk are in one line, as of somebody who stands or walks."""
    ankles = joints[:, ANKLES].mean(1)
    tall = np.linalg.norm(joints[:, NECK] - ankles, axis=-1)
    bones = [
        np.linalg.norm(joints[:, a] - joints[:, b], axis=-1)
        for leg in LEGS
        for a, b in pairwise(leg)
    ]
    trunk = np.linalg.norm(joints[:, NECK] - joints[:, 0], axis=-1)
    stands: Bool[Array, " F"] = tall > STRAIGHT * (trunk + sum(bones) / len(LEGS))
    return stands


def _from_feet(joints: Float[Array, "F J 3"]) -> Float[Array, "F 3"]:
    """From the middle of the feet to the centre of mass, unit."""
    mass = np.einsum("j,fjc->fc", np.array(list(MASS.values())), joints[:, list(MASS)])
    body: Array = mass - joints[:, FEET].mean(1)
    return body / np.linalg.norm(body, axis=-1, keepdims=True)


def _resting(ankles: Float[Array, "F 2 3"], fps: float) -> Bool[Array, "F 2"]:
    """Frames before and after which an ankle has hardly moved."""
    moved = np.linalg.norm(np.diff(ankles, axis=0), axis=-1) * fps
    fast = np.pad(moved, ((1, 1), (0, 0)))
    rests: Bool[Array, "F 2"] = np.maximum(fast[:-1], fast[1:]) < RESTS
    return rests


def _places(ankles: Float[Array, "N 3"]) -> Float[Array, "M 3"]:
    """The places where a foot rested, each once."""
    found: list[Array] = []
    for place in ankles:
        if all(np.linalg.norm(place - other) > SAME for other in found):
            found.append(place)
    return np.array(found).reshape(-1, 3)


def _joined(
    body_up: Float[Array, " 3"], places: Float[Array, "M 3"]
) -> tuple[Float[Array, " 3"], bool, float]:
    """Up that is near the body's and normal to the plane of the places, each as sure as it is.

    The second value tells whether the places fix both of its angles better than the body does, the
    third within how many degrees up is in nine of ten cases.
    """
    up = body_up
    across = np.linalg.svd(body_up[None])[2][1:]  # two directions along the floor
    prior = np.eye(2) / OFF_BODY**2
    informed = np.zeros((2, 2))
    for _ in range(ROUNDS if len(places) else 0):
        heights = places @ up
        away = heights - np.median(heights)
        weights = 1 / (1 + (away / OFF_FLOOR) ** 2)  # a foot on a step or a chair hardly counts
        middle = (weights[:, None] * places).sum(0) / weights.sum()
        flat = (places - middle) @ across.T
        level = (places - middle) @ body_up
        informed = (weights[:, None] * flat).T @ flat / OFF_FLOOR**2
        tilt = -np.linalg.solve(informed + prior, flat.T @ (weights * level) / OFF_FLOOR**2)
        up = _unit(body_up + tilt @ across)
    spread = np.sqrt(1 / np.linalg.eigvalsh(informed + prior)[0])
    within = round(float(np.degrees(NINE_OF_TEN * spread)), 1)
    return up, bool(np.linalg.eigvalsh(informed)[0] > prior[0, 0]), within


def _unit(vector: Float[Array, " 3"]) -> Float[Array, " 3"]:
    unit: Array = vector / np.linalg.norm(vector)
    return unit


@torch.no_grad()
def _posed(
    body: BodyModel, poses: BodyPose, rows: Sequence[int]
) -> Iterator[tuple[Float[Array, "C J 3"], Float[Array, "C V 3"]]]:
    """Joints and vertices of some frames, a chunk at a time."""
    for start in range(0, len(rows), CHUNK):
        out = body(poses.frame(torch.tensor(rows[start : start + CHUNK])))
        yield out.joints.double().numpy(), out.vertices.double().numpy()
