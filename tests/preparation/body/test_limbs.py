"""Limbs that nothing in the picture vouches for are said to be guesses."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hoigs.core.values.camera import Camera
from hoigs.core.values.moment import BodyPose
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.preparation.body.landmarks import JOINTS, Landmarks
from hoigs.preparation.body.limbs import LIMBS, guessed_limbs
from hoigs.preparation.body.mask_fit import silhouette

FRAMES = 2


@pytest.fixture(scope="module")
def scene() -> tuple[AnnyBody, BodyPose, Camera, Landmarks, np.ndarray]:
    """A body with its arms held out, its landmarks in both frames, and its mask."""
    body, poses = AnnyBody(), BodyPose.zeros(FRAMES).replace(betas=torch.zeros(10))
    camera = Camera.look_at(
        torch.tensor([0.0, 0.0, 3.0]), torch.tensor([0.0, -0.1, 0.0]), width=320, height=320,
        fov_y=0.8,
    ).to(torch.float32)  # fmt: skip
    out = body(poses.frame(0))
    pixels, _ = camera.project(out.joints)
    image = torch.full((FRAMES, 33, 3), torch.nan)
    for mark, joint in JOINTS.items():
        image[:, mark] = torch.cat((pixels[joint], torch.ones(1)))
    landmarks = Landmarks(image, torch.full((FRAMES, 33, 3), torch.nan))
    return body, poses, camera, landmarks, silhouette(out.vertices, body.faces, camera)


def test_limbs_that_are_seen_where_they_are_drawn_are_no_guesses(scene) -> None:
    body, poses, camera, landmarks, mask = scene
    found = guessed_limbs(body, poses, landmarks, [camera] * FRAMES, lambda _: mask)
    assert found == {limb: [] for limb in LIMBS}


@pytest.mark.parametrize("how", ["hidden", "out of the picture", "not found"])
def test_a_limb_whose_end_is_not_seen_is_a_guess_in_that_frame(scene, how) -> None:
    body, poses, camera, landmarks, mask = scene
    image = landmarks.image.clone()
    image[1, 16] = torch.tensor({
        "hidden": [100.0, 100.0, 0.1], "out of the picture": [-4.0, 100.0, 1.0],
        "not found": [torch.nan] * 3,
    }[how])  # fmt: skip
    given = Landmarks(image, landmarks.world)
    found = guessed_limbs(body, poses, given, [camera] * FRAMES, lambda _: mask)
    assert found == {limb: [1] if limb == "right arm" else [] for limb in LIMBS}


def test_a_limb_that_is_drawn_where_no_mask_is_is_a_guess(scene) -> None:
    body, poses, camera, landmarks, mask = scene
    pixels, _ = camera.project(body(poses.frame(0)).joints)
    without = mask.copy()
    without[:, int(pixels[18, 0]) :] = False  # the left forearm, on the right of the picture
    masks = [without, np.zeros_like(mask)]  # of the second frame nothing is known
    found = guessed_limbs(body, poses, landmarks, [camera] * FRAMES, masks.__getitem__)
    assert found == {limb: [0] if limb == "left arm" else [] for limb in LIMBS}
