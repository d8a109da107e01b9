"""World: a unit up, a floor, who knows; where nobody does, up is of the cameras, which is said."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.values.world import World
from hoigs.testing.material import tiny_clip


def test_up_is_a_unit_vector_and_comes_back_from_json():
    world = World(up=(0.0, 3.0, 4.0), floor=0.25, metres=False, known="floor")
    assert world.up == (0.0, 0.6, 0.8)
    assert World.from_dict(world.to_dict()) == world


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"up": (0.0, 0.0, 0.0)}, "up"),
        ({"up": (0.0, math.nan, 1.0)}, "up"),
        ({"up": (0.0, 1.0, 0.0), "floor": math.inf}, "floor"),
        ({"up": (0.0, 1.0, 0.0), "known": "guess"}, "known"),
    ],
)
def test_values_that_mean_nothing_are_refused(wrong, named):
    with pytest.raises(ValueError, match=named):
        World(**wrong)


def test_a_clip_that_knows_nothing_guesses_by_its_cameras_once():
    clip = replace(tiny_clip(), world=None)
    mean = torch.stack([-c.world_to_camera[1, :3] for c in clip.cameras]).mean(0)
    assert clip.world.is_guess and clip.world.floor is None
    torch.testing.assert_close(clip.up(), mean / mean.norm())
    turn = torch.eye(4)
    turn[:3, :3] = axis_angle_to_matrices(torch.tensor((0.0, 0.0, 1.0)))
    turned = [replace(c, world_to_camera=turn @ c.world_to_camera) for c in clip.cameras]
    assert replace(clip, cameras=turned).world == clip.world


def test_cameras_that_roll_over_still_have_an_up():
    camera = tiny_clip().cameras[0]
    over = torch.diag(torch.tensor((-1.0, -1.0, 1.0, 1.0))) @ camera.world_to_camera
    world = World.guessed([camera, replace(camera, world_to_camera=over)])
    torch.testing.assert_close(world.up_vector(), -camera.world_to_camera[1, :3])
