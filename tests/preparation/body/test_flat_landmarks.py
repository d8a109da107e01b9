"""Landmarks in the image alone drive the body fit: the body's own points, projected."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from test_body_fit import FRAMES, QUICK, body, camera, joint_errors, seen_by, truth
from torch import Tensor

from hoigs.core.interfaces.estimator import (
    BODY_25_LANDMARKS,
    COCO_17_LANDMARKS,
    landmarks_from_keypoints,
)
from hoigs.core.maths.rotations import axis_angle_to_matrices, matrices_to_axis_angle
from hoigs.preparation.body.fit import fit_body
from hoigs.preparation.body.fit_problem import Observations
from hoigs.preparation.body.fitted import BodyFit
from hoigs.preparation.body.landmarks import ENOUGH, SOLID, USED, Landmarks
from hoigs.preparation.body.start import flat_start, place, relaxed


def flat(targets: tuple[int, ...]) -> Landmarks:
    """What a 2D detector of another convention sees of the body."""
    image = seen_by([camera()] * FRAMES, truth()).image.numpy()
    keypoints = np.stack([image[:, max(t, 0)] for t in targets], 1)
    found = landmarks_from_keypoints(keypoints, targets).image_xyzv
    return Landmarks.from_mediapipe(found, np.full_like(found, np.nan))


@cache
def coco_fit() -> BodyFit:
    return fit_body(
        body(), Observations(flat(COCO_17_LANDMARKS), [camera()] * FRAMES), options=QUICK
    )


def centred(joints: Tensor) -> Tensor:
    return joints - joints.mean(1, keepdim=True)


def test_coco_keypoints_drive_the_fit() -> None:
    fit = coco_fit()
    assert fit.report["frames_with_landmarks"] == FRAMES
    assert fit.report["frames_with_landmarks_in_space"] == 0
    assert fit.residual_px.max() < 4.0
    with torch.no_grad():
        found, true = body()(fit.poses).joints[:, :22], body()(truth()).joints[:, :22]
    # across the view the body is known, along it only as far as an estimator goes
    assert (centred(found) - centred(true))[..., :2].norm(dim=-1).mean() < 0.05
    assert (centred(found) - centred(true))[..., 2].abs().mean() < 0.12
    assert (found[:, 0, 2] / true[:, 0, 2] - 1).abs().max() < 0.12
    # the heels, which COCO has not, are not where a T-pose or a turned body would have them
    assert joint_errors(fit.poses, truth())[:, [7, 8]].mean() < 0.3


def test_frames_with_a_few_landmarks_count_and_hidden_limbs_are_carried() -> None:
    track = seen_by([camera()] * FRAMES, truth())
    image = track.image.clone()
    image[3:5, [15, 16, 25, 26, 27, 28, 29, 30, 31, 32]] = torch.nan
    fit = fit_body(
        body(), Observations(replace(track, image=image), [camera()] * FRAMES), options=QUICK
    )
    assert fit.report["frames_with_landmarks"] == FRAMES
    assert torch.isfinite(fit.residual_px).all() and fit.residual_px.max() < 4.0
    assert joint_errors(fit.poses, truth()).mean() < 0.06


def test_which_frames_count() -> None:
    track = flat(BODY_25_LANDMARKS)
    assert track.found.all() and not track.solid.any()
    known = track.known[0, list(USED)].nonzero().squeeze(1).tolist()
    image = track.image.clone()
    image[0, [USED[k] for k in known[ENOUGH:]]] = torch.nan
    image[1, [USED[k] for k in known[ENOUGH - 1 :]]] = torch.nan
    assert replace(track, image=image).found.tolist() == [True, False] + [True] * (FRAMES - 2)
    assert set(SOLID) <= set(USED)


@pytest.mark.parametrize("turn", [0.0, 1.0, -2.0, 3.0])
def test_the_start_faces_as_the_person_does(turn: float) -> None:
    pose = truth()
    orient = pose.global_orient.clone()
    # upright in the image, turned about the body's own axis
    half = torch.tensor([torch.pi, 0.0, 0.0])
    matrix = axis_angle_to_matrices(half) @ axis_angle_to_matrices(torch.tensor([0.0, turn, 0.0]))
    orient[:] = matrices_to_axis_angle(matrix[None])[0]
    pose = pose.replace(global_orient=orient, body=relaxed().expand(FRAMES, 21, 3).clone())
    track = seen_by([camera()] * FRAMES, pose)
    image = torch.where(track.image[..., 2:] > 0, track.image, torch.nan)
    K = torch.stack([camera().K] * FRAMES)
    rotations, world = flat_start(body(), image, K)
    away = torch.acos(
        (((rotations.mT @ matrix).diagonal(dim1=-1, dim2=-2).sum(-1) - 1) / 2).clamp(-1, 1)
    )
    assert away.max() < np.deg2rad(16), "the directions tried are 15 degrees apart"
    off = place(image, world, K) - place(
        image, torch.where(image[..., 2:] > 0, track.world, torch.nan), K
    )
    assert off.norm(dim=-1).max() < 0.4


def test_placing_is_exact_and_ignores_what_is_unknown() -> None:
    track = seen_by([camera()] * FRAMES, truth())
    K = torch.stack([camera().K] * FRAMES)
    image = torch.where(track.image[..., 2:] > 0, track.image, torch.nan)
    found = place(image, track.world, K)
    image[:, 20, :] = torch.nan
    world = track.world.clone()
    world[:, 13] = torch.nan
    again = place(image, world, K)
    torch.testing.assert_close(again, found, atol=1e-4, rtol=0)
    pixels = (track.world + found[:, None]) @ K.mT
    off = pixels[..., :2] / pixels[..., 2:] - track.image[..., :2]
    assert off[track.image[..., 2] > 0].norm(dim=-1).max() < 0.01
