from __future__ import annotations

import numpy as np
import pytest
import torch

from hoigs.core.errors import HoigsError
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.synthesis import SceneConfig, SyntheticScene
from hoigs.synthesis.choreography import WRISTS, Choreographer, hand_targets, palms
from hoigs.synthesis.object_motions import MOTIONS, ObjectScript

ARM_PARTS = (6, 7, 8, 9)


def _perform(body: AnnyBody, **choices: object):  # type: ignore[no-untyped-def]
    config = SceneConfig.tiny(frames=24, fps=6.0, object=choices)
    script = MOTIONS[config.object.motion](config).script()
    return config, script, Choreographer(body, config).perform(script)


def _contact_errors(
    body: AnnyBody, config: SceneConfig, script: ObjectScript, poses: object
) -> np.ndarray:
    """Distance of each palm from where it should touch, through the body itself, metres."""
    joints = body(poses).joints.numpy()
    turn = body.skinning_transforms(poses)[..., :3, :3].numpy()
    targets = hand_targets(script, config.object.size)
    errors = []
    for side, (wrist, palm) in enumerate(zip(WRISTS, palms(body, poses.betas), strict=True)):
        place = joints[:, wrist] + turn[:, wrist] @ palm.offset
        target = script.walk.to_world(targets.points[side])
        errors.append(np.linalg.norm(place - target, axis=-1))
    return np.stack(errors)


@pytest.mark.parametrize("motion", MOTIONS)
def test_palms_touch_the_object_within_a_millimetre(body: AnnyBody, motion: str) -> None:
    config, script, poses = _perform(body, motion=motion)
    assert _contact_errors(body, config, script, poses).max() < 1e-3


def test_palms_lie_on_the_sides_of_the_held_box(body: AnnyBody, scene: SyntheticScene) -> None:
    config, script, poses = scene.config, scene.script, scene.poses
    joints = body(poses).joints.numpy()
    turn = body.skinning_transforms(poses)[..., :3, :3].numpy()
    held = script.grip > 0.999
    assert held.sum() > 12
    for side, wrist, palm in zip((1, -1), WRISTS, palms(body, poses.betas), strict=True):
        place = joints[:, wrist] + turn[:, wrist] @ palm.offset
        local = np.einsum("fi,fij->fj", place - script.track.translations, script.track.rotations)[
            held
        ]
        np.testing.assert_allclose(local[:, 0], side * config.object.size[0] / 2, atol=1e-3)
        assert (np.abs(local[:, 1:]) < np.array(config.object.size[1:]) / 2).all()
        # the palm's normal points into the box
        normal = (turn[:, wrist] @ palm.frame[:, 1])[held]
        inward = -side * script.track.rotations[held][:, :, 0]
        assert (normal * inward).sum(-1).min() > 0.999


def test_the_box_stays_clear_of_the_body_and_hands_do_not_sink_in(
    body: AnnyBody, scene: SyntheticScene
) -> None:
    vertices = body(scene.poses).vertices.numpy()
    track = scene.script.track
    local = np.einsum("fvi,fij->fvj", vertices - track.translations[:, None], track.rotations)
    inside = (np.array(scene.config.object.size) / 2 - np.abs(local)).min(-1)
    arms = np.isin(body.vertex_parts.numpy(), ARM_PARTS)
    assert inside[:, ~arms].max() < -0.03
    assert inside[:, arms].max() < 0.01


def test_feet_stand_still_on_the_floor(body: AnnyBody, scene: SyntheticScene) -> None:
    output = body(scene.poses)
    feet = output.joints[:, [7, 8, 10, 11]]
    assert (feet - feet[0]).abs().max() < 1e-4
    soles = output.vertices[..., 1].min(-1).values
    assert soles.abs().max() < 1e-3


def test_knees_and_elbows_bend_the_way_they_do(scene: SyntheticScene) -> None:
    pose = scene.poses.body
    knees = pose[:, [3, 4]]  # joints 4 and 5
    assert (knees[..., 0] > 0.1).all() and (knees[..., 0] < 1.6).all()
    # forearms also twist; the hinge's share is about -y on the left and +y on the right
    assert (pose[:, 17, 1] < -0.2).all() and (pose[:, 18, 1] > 0.2).all()
    assert pose[:, [19, 20]].norm(dim=-1).max() < np.radians(75)  # wrists


def test_motion_is_smooth(body: AnnyBody) -> None:
    config = SceneConfig()
    script = MOTIONS["held"](config).script()
    joints = body(Choreographer(body, config).perform(script)).joints
    speed = joints.diff(dim=0).norm(dim=-1)
    assert speed.max() < 0.13  # metres a frame
    assert joints.diff(n=2, dim=0).norm(dim=-1).max() < 0.05


def test_other_bodies_reach_too(body: AnnyBody) -> None:
    for shape in ((2.0,), (-2.0, 1.0)):
        config = SceneConfig.tiny(betas=shape)
        script = MOTIONS["held"](config).script()
        poses = Choreographer(body, config).perform(script)
        assert poses.betas[0] == shape[0]
        assert _contact_errors(body, config, script, poses).max() < 1e-3


def test_out_of_reach_says_which_frame_and_what_to_do(body: AnnyBody) -> None:
    with pytest.raises(HoigsError, match=r"frame \d+ .* short of the object.*object\.size"):
        _perform(body, size=(1.6, 0.2, 0.2))


def test_too_many_betas_are_refused(body: AnnyBody) -> None:
    with pytest.raises(HoigsError, match=r"betas has 11 coefficients.*has 10"):
        Choreographer(body, SceneConfig.tiny(betas=(0.0,) * 11))


def test_poses_are_batched_float32(scene: SyntheticScene) -> None:
    poses = scene.poses
    assert poses.body.shape == (24, 21, 3) and poses.left_hand.shape == (24, 15, 3)
    assert poses.transl.dtype == torch.float32 and poses.hand_pose_convention == "flat"
