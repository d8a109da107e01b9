"""Masks in the body fit: they place limbs in frames without landmarks; empty ones are mute."""

from __future__ import annotations

import numpy as np
import torch
from test_body_fit import FRAMES, HEIGHT, QUICK, WIDTH, body, camera, seen_by, truth
from torch import Tensor

from hoigs.core.values.moment import BodyPose
from hoigs.preparation.body.fit import fit_body
from hoigs.preparation.body.fit_problem import Observations
from hoigs.preparation.body.fitted import BodyFit
from hoigs.preparation.body.kinematics import PER_FRAME, NormalEquations
from hoigs.preparation.body.landmarks import Landmarks
from hoigs.preparation.body.mask_fit import MaskFit, posed, silhouette

UNSEEN = slice(5, FRAMES)
KNEE, ANKLE, WRIST = 5, 8, 20


def outlines(pose: BodyPose) -> list[np.ndarray]:
    return [silhouette(vertices, body().faces, camera()) for vertices, _ in posed(body(), pose)]


def half_seen() -> Landmarks:
    whole = seen_by([camera()] * FRAMES, truth())
    image, world = whole.image.clone(), whole.world.clone()
    image[UNSEEN] = world[UNSEEN] = torch.nan
    return Landmarks(image, world)


def missed(fit: BodyFit) -> Tensor:
    """Mean distance of knee, ankle and wrist from the truth in frames without landmarks, pixels."""
    off = []
    for pose in (fit.poses, truth()):
        joints = torch.stack([joints for _, joints in posed(body(), pose)])
        off.append(torch.stack([camera().project(j[[KNEE, ANKLE, WRIST]])[0] for j in joints]))
    return (off[0] - off[1]).norm(dim=-1)[UNSEEN].mean()


def test_masks_place_limbs_where_there_are_no_landmarks() -> None:
    cameras, landmarks = [camera()] * FRAMES, half_seen()
    without = missed(fit_body(body(), Observations(landmarks, cameras), options=QUICK))
    with_masks = missed(
        fit_body(body(), Observations(landmarks, cameras, masks=outlines(truth())), options=QUICK)
    )
    assert with_masks < 0.6 * without, (with_masks, without)


def project(points: Tensor, frames: Tensor) -> tuple[Tensor, Tensor]:
    del frames  # one camera, at the origin, sees them all
    by_points = torch.func.vmap(torch.func.vmap(torch.func.jacrev(pixels)))
    return pixels(points), by_points(points)


def pixels(points: Tensor) -> Tensor:
    K = camera().K.double()
    at = points @ K.T
    return at[..., :2] / at[..., 2:]


def test_the_energy_is_least_at_the_truth_and_a_thing_far_off_hardly_counts() -> None:
    pose, masks = truth(), outlines(truth())
    aside = pose.replace(transl=pose.transl + torch.tensor([0.15, 0.0, 0.0]))
    held = [mask.copy() for mask in masks]
    for mask in held:
        mask[HEIGHT - 60 :, WIDTH - 60 :] = True

    def energy(masks: list[np.ndarray], pose: BodyPose) -> float:
        return float(MaskFit(body(), dict(enumerate(masks)), 0.03).energy(pose, project, 1.0))

    alone = energy(masks, pose)
    assert alone < 0.2 * energy(masks, aside)
    assert energy(held, pose) < 0.5 * energy(held, aside)


def test_an_empty_or_absent_mask_says_nothing() -> None:
    masks = outlines(truth())
    masks[3] = np.zeros((HEIGHT, WIDTH), bool)
    pose = truth()
    pose = pose.replace(transl=pose.transl + 0.1)
    some = {i: masks[i] for i in range(1, FRAMES)}
    equations = NormalEquations(FRAMES, PER_FRAME, body().num_betas)
    MaskFit(body(), some, 0.03).energy(pose, project, 1.0, equations)
    by_transl = equations.by_frame[:, :3]
    assert torch.isfinite(by_transl).all()
    assert (by_transl[[0, 3]] == 0).all() and (by_transl[2] != 0).any()
