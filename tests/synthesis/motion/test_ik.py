from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.synthesis.generate import SyntheticScene
from hoigs.synthesis.kinematics import (
    about,
    forward_kinematics,
    frame_of,
    twist_about,
    two_bone,
    unit,
)

UPPER, LOWER = np.array([0.28, 0.01, 0.0]), np.array([0.25, 0.0, -0.01])
HINGE = np.array([0.0, -1.0, 0.0])


def _solve(target: np.ndarray, pole: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    start = np.zeros((1, 3))
    return two_bone(start, target[None], pole[None], (UPPER, LOWER), HINGE)


@settings(max_examples=60, deadline=None)
@given(
    st.floats(0.06, 0.52), st.integers(0, 10_000)
)  # any distance within reach, any direction and pole
def test_two_bones_reach_their_target(distance: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    target, pole = distance * unit(rng.normal(size=3)), unit(rng.normal(size=3))
    upper, lower, missed = _solve(target, pole)
    tip = upper[0] @ UPPER + lower[0] @ LOWER
    assert missed[0] < 1e-9
    np.testing.assert_allclose(tip, target, atol=1e-9)


def test_both_bones_turn_about_one_hinge_on_the_side_of_the_pole() -> None:
    target, pole = np.array([0.1, -0.35, 0.1]), unit(np.array([0.7, -0.2, -0.6]))
    upper, lower, _ = _solve(target, pole)
    elbow = upper[0] @ UPPER
    aside = elbow - (elbow @ unit(target)) * unit(target)
    assert aside @ pole > 0
    bend = upper[0].T @ lower[0]  # at the elbow, in the upper arm's frame
    axis = Rotation.from_matrix(bend).as_rotvec()
    # the rest bones are not quite straight, so the hinge is the given one to within that angle
    assert abs(unit(axis) @ HINGE) > 0.999


def test_a_target_beyond_reach_is_approached_and_measured() -> None:
    target = np.array([0.9, 0.0, 0.0])
    upper, lower, missed = _solve(target, np.array([0.0, 0.0, -1.0]))
    tip = upper[0] @ UPPER + lower[0] @ LOWER
    np.testing.assert_allclose(np.linalg.norm(tip - target), missed[0], atol=1e-9)
    assert missed[0] > 0.36


def test_twist_is_the_part_about_the_axis() -> None:
    axis = unit(np.array([1.0, 0.2, -0.1]))
    angles = np.linspace(-2.0, 2.0, 9)
    swing = about(unit(np.cross(axis, [0, 1, 0])), np.full(9, 0.6))
    np.testing.assert_allclose(twist_about(swing @ about(axis, angles), axis), angles, atol=1e-9)


def test_frames_are_right_handed_and_orthonormal() -> None:
    frame = frame_of(np.array([1.0, 0.3, 0.0]), np.array([0.2, 1.0, 0.4]))
    np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-12)
    assert np.linalg.det(frame) > 0


def test_forward_kinematics_agrees_with_the_body(body: AnnyBody, scene: SyntheticScene) -> None:
    poses = scene.poses
    local = Rotation.from_rotvec(poses.rotations.double().numpy().reshape(-1, 3)).as_matrix()
    rest = body.shaped(poses.betas)[1].double().numpy()
    root = rest[0] + poses.transl.double().numpy()
    local = local.reshape(len(root), -1, 3, 3)
    _, places = forward_kinematics(local, rest, body.parents, root)
    np.testing.assert_allclose(places, body(poses).joints.numpy(), atol=1e-5)
