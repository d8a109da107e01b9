"""A ball that is known by its masks alone."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hoigs.core.values.camera import Camera
from hoigs.preparation.mask_stack import MaskStack
from hoigs.preparation.objects.ball import (
    FLESH,
    NoBallError,
    ball_cones,
    clear_radius,
    contact_radius,
    fit_cone,
    require_round,
)
from hoigs.preparation.objects.filmed import Filmed
from hoigs.preparation.objects.make_object import make_object

FRAMES, WIDTH, HEIGHT, F, RADIUS = 12, 160, 120, 110.0, 0.11
CAMERA = Camera(torch.tensor([[F, 0, 80], [0, F, 60], [0, 0, 1]]), torch.eye(4), WIDTH, HEIGHT)
CAMERAS = [CAMERA] * FRAMES
PHASE = np.linspace(0, 2, FRAMES)
CENTERS = np.stack((0.8 * np.cos(PHASE), 0.5 * np.sin(PHASE), 1.5 + 0.3 * np.sin(PHASE)), -1)
NOBODY = MaskStack([np.zeros((HEIGHT, WIDTH), bool)] * FRAMES)


def rays() -> np.ndarray:
    flat = (CAMERA.pixel_grid().numpy() - [80, 60]) / F
    found = np.concatenate((flat, np.ones((HEIGHT, WIDTH, 1))), -1)
    return found / np.linalg.norm(found, axis=-1, keepdims=True)


def balls(stretched: float = 1.0) -> MaskStack:
    """Silhouettes of spheres, or of what is longer than broad."""
    masks = MaskStack()
    for center in CENTERS:
        away = rays() * (rays() @ center)[..., None] - center
        masks.append((away**2 / [stretched**2, 1, 1]).sum(-1) < RADIUS**2)
    return masks


def test_a_ball_is_where_its_cone_of_rays_touches_it() -> None:
    cones = ball_cones(balls(), NOBODY, CAMERAS)
    require_round(cones, CAMERAS)
    off = np.linalg.norm(cones.places(CAMERAS, RADIUS).numpy() - CENTERS, axis=-1)
    assert off.mean() < 0.012 and off.max() < 0.02
    # the centre's direction is not that of the outline's middle
    y, x = np.nonzero(balls()[0])
    middle = np.array([(x.mean() + 0.5 - 80) / F, (y.mean() + 0.5 - 60) / F])
    exact = cones.directions[0, :2] / cones.directions[0, 2]
    true = CENTERS[0, :2] / CENTERS[0, 2]
    assert np.linalg.norm(exact - true) < 0.5 * np.linalg.norm(middle - true)


def test_a_hidden_part_does_not_move_it() -> None:
    masks, people = MaskStack(), MaskStack()
    for mask in balls():
        _, x = np.nonzero(mask)
        arm = np.zeros_like(mask)
        arm[:, : int(np.quantile(x, 0.2))] = True
        masks.append(mask & ~arm)
        people.append(arm)
    cones = ball_cones(masks, people, CAMERAS)
    off = np.linalg.norm(cones.places(CAMERAS, RADIUS).numpy() - CENTERS, axis=-1)
    assert np.median(off) < 0.03


@pytest.mark.parametrize("shape", ["long", "square"])
def test_other_outlines_are_no_balls(shape: str) -> None:
    masks = balls(1.4)
    if shape == "square":
        masks = MaskStack([np.pad(np.ones((20, 20), bool), ((50, 50), (70, 70)))] * FRAMES)
    with pytest.raises(NoBallError, match="circle"):
        require_round(ball_cones(masks, NOBODY, CAMERAS), CAMERAS)


def test_a_bow_is_no_part_of_a_large_ball() -> None:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    away = np.hypot(x - 20, y - 60)
    masks = MaskStack([(abs(away - 100) < 3) & (abs(y - 60) < 30)] * FRAMES)
    with pytest.raises(NoBallError):
        require_round(ball_cones(masks, NOBODY, CAMERAS), CAMERAS)


def test_cones_ignore_rays_far_off() -> None:
    turns = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    ring = np.stack((0.05 * np.cos(turns) + 0.3, 0.05 * np.sin(turns), np.ones(60)), -1)
    ring[:8, :2] += 0.04
    ring /= np.linalg.norm(ring, axis=-1, keepdims=True)
    axis, angle, _ = fit_cone(ring)
    clean, sure, _ = fit_cone(ring[8:])
    assert np.linalg.norm(axis - clean) < 0.003 and abs(angle - sure) < 0.003


def test_a_ball_seen_whole_stays_in_front_of_the_limbs_that_it_hides() -> None:
    masks = balls()
    cones = ball_cones(masks, NOBODY, CAMERAS)
    joints = torch.zeros(FRAMES, 22, 3) + torch.tensor([0.0, 9, 9])  # far beside the ball
    parents = (-1, *range(21))
    assert clear_radius(cones, masks, joints, parents, CAMERAS) is None
    centers = torch.from_numpy(CENTERS).float()
    behind = centers / centers.norm(dim=-1, keepdim=True)  # the cameras stand at the origin
    joints[:, 10] = centers + behind * (RADIUS + FLESH)  # touches the ball's far side
    found = clear_radius(cones, masks, joints, parents, CAMERAS)
    assert found is not None and found[1] > FRAMES / 2
    assert found[0] == pytest.approx(RADIUS, rel=0.05)
    # where the mask is not, the limb hides the ball
    assert clear_radius(cones, NOBODY, joints, parents, CAMERAS) is None


def test_limbs_give_the_radius_and_the_rotation_stays_unknown() -> None:
    joints = torch.zeros(FRAMES, 52, 3) + torch.tensor([0.0, 0, 9])
    centers = torch.from_numpy(CENTERS).float()
    joints[:, 10] = centers + torch.tensor([0, RADIUS, 0])  # on the left foot
    found = contact_radius(ball_cones(balls(), NOBODY, CAMERAS), joints, CAMERAS)
    assert found is not None and found[0] == pytest.approx(RADIUS, rel=0.05)
    assert found[1] == FRAMES and found[2] < 0.05
    images = [np.full((HEIGHT, WIDTH, 3), 90, np.uint8)] * FRAMES
    parents = (-1, *range(51))
    shown = Filmed(
        balls(), NOBODY, NOBODY, CAMERAS, lambda: iter(images), 12.0, joints, parents
    )  # fmt: skip
    made = make_object(
        None, shown, way="auto", radius=None, count=200, progress=lambda _: None
    )  # fmt: skip
    assert made.confidence.way == "ball" and "no outline shows" in made.confidence.reason
    assert "rotation is unknown" in made.track.provenance and not made.track.rotation_known
    assert torch.equal(made.track.rotations, torch.eye(3).expand(FRAMES, 3, 3))
    torch.testing.assert_close(
        made.track.points.norm(dim=-1), torch.full((200,), found[0]), atol=1e-5, rtol=0
    )


def test_the_arc_that_the_border_of_the_picture_leaves_proves_no_ball() -> None:
    """The tip of a surfboard at the lower edge of the picture was a ball of 0.8 m."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    tips = MaskStack((x - WIDTH / 2) ** 2 + (y - HEIGHT - 30) ** 2 < 50**2 for _ in CAMERAS)
    with pytest.raises(NoBallError, match="most of its circle"):
        require_round(ball_cones(tips, NOBODY, CAMERAS), CAMERAS)
