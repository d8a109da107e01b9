"""Up and floor from people: who stands tells up, and feet at several places tell it better."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hoigs.core.model.standing import world_of_people
from hoigs.core.values.moment import BodyPose
from hoigs.core.values.world import World
from hoigs.plugins.bodies.anny import AnnyBody

FPS, STAY = 10.0, 6
SQUARE = [(0.0, 0.0), (1.0, 0.1), (1.2, 1.0), (0.1, 1.1)]
TILT = Rotation.from_euler("xyz", (150, 20, 35), degrees=True)  # y down, as of an OpenCV camera
SHIFT = np.array((0.3, -1.2, 2.5))


@pytest.fixture(scope="module")
def body() -> AnnyBody:
    return AnnyBody()


def stood(body: AnnyBody, places, *, bent: float = 0.0, steps=()) -> BodyPose:
    """Poses of somebody who stays at each place (x, z) for `STAY` frames, in the tilted world.

    Args:
        bent: of hips and knees, radians. steps: heights of what they stand on, by place.
    """
    turns = BodyPose.zeros(STAY * len(places), betas=body.num_betas)
    turns.body[:, (0, 1), 0] = -bent  # hips
    turns.body[:, (3, 4), 0] = bent  # knees
    turns.body[:, 15, 2], turns.body[:, 16, 2] = -1.1, 1.1  # arms down
    vertices, joints = body.shaped(turns.betas)
    pelvis = joints[0].double().numpy()
    rows = []
    for i, (x, z) in enumerate(places):
        height = -float(vertices[:, 1].min()) + dict(steps).get(i, 0.0)
        rows += [(x, height, z)] * STAY
    root = TILT.apply(np.array(rows) + pelvis) + SHIFT - pelvis
    return turns.replace(
        global_orient=torch.from_numpy(TILT.as_rotvec()).float().expand(len(rows), 3),
        transl=torch.from_numpy(root).float(),
    )


def degrees_off(world: World) -> float:
    return math.degrees(math.acos(np.clip(TILT.apply((0, 1, 0)) @ world.up, -1, 1)))


@pytest.mark.parametrize("steps", [(), ((2, 0.4),)])
def test_feet_that_stood_in_several_places_tell_the_floor(steps, body):
    places = [*SQUARE, (0.6, 0.5), (0.5, 1.6)]  # with a step up at one of them
    world = world_of_people([(body, stood(body, places, steps=steps))], FPS)
    assert world is not None and world.known == "floor"
    assert degrees_off(world) < 0.6 and world.floor == pytest.approx(SHIFT @ world.up, abs=0.02)


def test_who_stands_in_one_place_tells_up_by_balance(body):
    world = world_of_people([(body, stood(body, SQUARE[:1]))], FPS)
    assert world is not None and world.known == "body"
    assert degrees_off(world) < 4 and world.floor == pytest.approx(SHIFT @ world.up, abs=0.02)


def test_who_never_stands_tells_nothing(body):
    assert world_of_people([(body, stood(body, SQUARE, bent=1.5))], FPS) is None
    assert world_of_people([], FPS) is None


def test_frames_of_standing_count_alone(body):
    sits, stands = stood(body, SQUARE[:1], bent=1.5), stood(body, SQUARE[:1])
    both = BodyPose(**{
        name: torch.cat((getattr(sits, name), getattr(stands, name)))
        for name in ("global_orient", "body", "left_hand", "right_hand", "transl")
    }, betas=stands.betas)  # fmt: skip
    world, alone = (world_of_people([(body, p)], FPS) for p in (both, stands))
    assert world is not None and alone is not None and world.up == pytest.approx(alone.up, abs=1e-6)
