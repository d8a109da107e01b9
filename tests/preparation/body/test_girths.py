"""Girths by the outlines of masks: a stout body is found under a mean one, behind a table too."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from test_body_fit import FRAMES, QUICK, body, camera, seen_by, truth
from test_mask_fit import outlines
from torch import Tensor

from hoigs.core.values.moment import BodyPose
from hoigs.preparation.body.fit import fit_body
from hoigs.preparation.body.fit_problem import Observations
from hoigs.preparation.body.girths import girths
from hoigs.preparation.body.kinematics import Kinematics

STOUT = torch.tensor([0.0, 0.0, 2.0, *[0.0] * 7])


def stout() -> BodyPose:
    return truth().replace(betas=STOUT)


def off(betas: Tensor) -> float:
    """Mean distance of the skin from the stout body's, millimetres."""
    found, true = (body().shaped(b.float())[0] for b in (betas, STOUT))
    return float(1000 * (found - true).norm(dim=-1).mean())


def joints(betas: Tensor) -> Tensor:
    none = torch.zeros(0, dtype=torch.long)
    return torch.einsum("b,bjc->jc", betas.double(), Kinematics(body(), none, none).joints_by_betas)


def behind_a_table(mask: np.ndarray) -> np.ndarray:
    rows = np.flatnonzero(mask.any(1))
    seen = mask.copy()
    seen[(rows[0] + rows[-1]) // 2 :] = False
    return seen


@pytest.mark.parametrize("hide", [np.asarray, behind_a_table])
def test_a_stout_body_is_found_and_its_joints_stay(hide) -> None:
    masks = {i: hide(mask) for i, mask in enumerate(outlines(stout()))}
    found = girths(body(), truth(), [camera()] * FRAMES, masks)
    assert off(found) < 0.5 * off(truth().betas), (off(found), off(truth().betas))
    assert float(joints(found).norm(dim=-1).max()) < 0.01


def test_empty_masks_leave_the_mean_body() -> None:
    empty = dict.fromkeys(range(FRAMES), np.zeros((camera().height, camera().width), bool))
    assert float(girths(body(), truth(), [camera()] * FRAMES, empty).abs().max()) < 1e-6


def test_a_fit_with_masks_has_their_girths() -> None:
    cameras = [camera()] * FRAMES
    landmarks = seen_by(cameras, stout())
    without = fit_body(body(), Observations(landmarks, cameras), options=QUICK)
    masks = outlines(stout())
    fit = fit_body(body(), Observations(landmarks, cameras, masks=masks), options=QUICK)
    assert off(fit.poses.betas) < 0.7 * off(without.poses.betas)
