"""A rod that a hand holds: its direction in space, its length and its breadth, from masks."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw

from hoigs.core.interfaces.body import LEFT_WRIST, RIGHT_WRIST
from hoigs.core.values.camera import Camera
from hoigs.preparation.mask_stack import MaskStack
from hoigs.preparation.objects.filmed import Filmed
from hoigs.preparation.objects.hands import INDEX, LITTLE, MIDDLE
from hoigs.preparation.objects.make_object import make_object
from hoigs.preparation.objects.rod import _carried, rod_object
from hoigs.preparation.objects.watched import UntrackableError

FRAMES, WIDTH, HEIGHT, LENGTH, RADIUS = 30, 320, 240, 0.8, 0.012
CAMERA = Camera(
    torch.tensor([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]), torch.eye(4), WIDTH, HEIGHT
)


def directions() -> torch.Tensor:
    """A swing that leads away from the camera for a while: [F, 3]."""
    t = torch.linspace(0, 1, FRAMES)
    turn, tilt = 0.4 + 2.2 * t, 0.9 * torch.sin(np.pi * t)
    return torch.stack((turn.cos() * tilt.cos(), turn.sin() * tilt.cos(), tilt.sin()), -1)


def grips() -> torch.Tensor:
    t = torch.linspace(0, 1, FRAMES)
    return torch.stack((0.1 * t - 0.1, 0.1 * t - 0.15, 2.0 + 0.1 * t), -1)


def filmed(back: float = 0.0, radius: float = RADIUS) -> Filmed:
    masks, images = [], []
    joints = torch.full((FRAMES, 52, 3), 1.0) + torch.tensor([0.0, 0.0, 2.0])
    for i, (way, grip) in enumerate(zip(directions(), grips(), strict=True)):
        ends = torch.stack((grip - back * way, grip + LENGTH * way))
        xy, depth = CAMERA.project(ends)
        fine = Image.new("L", (4 * WIDTH, 4 * HEIGHT))
        wide = max(1, round(float(8 * radius * 300 / depth.mean())))
        ImageDraw.Draw(fine).line([tuple(p) for p in (4 * xy).tolist()], fill=255, width=wide)
        mask = np.asarray(fine.resize((WIDTH, HEIGHT), Image.Resampling.BOX)) > 127
        masks.append(mask)
        images.append(np.where(mask[..., None], (40, 40, 45), 120).astype(np.uint8))
        far = grip + torch.tensor([0.9, 0.5, 0.3])
        for palm, wrist, first in ((far, LEFT_WRIST, 22), (grip, RIGHT_WRIST, 37)):
            across = torch.tensor([0.0, 0.03, 0.0])
            joints[i, wrist] = palm - torch.tensor([0.04, 0.0, 0.0])
            joints[i, first + MIDDLE] = palm + torch.tensor([0.04, 0.0, 0.0])
            joints[i, first + INDEX], joints[i, first + LITTLE] = palm + across, palm - across
    none = MaskStack(np.zeros_like(m) for m in masks)
    return Filmed(
        MaskStack(masks), none, none, [CAMERA] * FRAMES, lambda: iter(images), 12.0, joints,
        (-1, *range(51)),
    )  # fmt: skip


def test_direction_length_and_breadth_of_a_swung_rod() -> None:
    track, normals, spread, confidence = rod_object(filmed(), 400)
    found = track.rotations[:, :, 0]
    # the mirror image, which leads towards the camera, looks the same
    mirrored = found * torch.tensor([1.0, 1.0, -1.0])
    off = [torch.rad2deg(torch.acos((one * directions()).sum(-1).clamp(-1, 1))) for one in
           (found, mirrored)]  # fmt: skip
    nearest = min(off, key=lambda o: float(o.mean()))
    assert float(nearest.mean()) < 9 and float(nearest.max()) < 22
    x = track.points[:, 0]
    assert float(x.max() - x.min()) == pytest.approx(LENGTH, abs=0.07)
    radius = track.points[:, 1:].norm(dim=-1)
    assert float(radius.median()) == pytest.approx(RADIUS, abs=0.004)
    assert (normals[:, 0] == 0).all() and 0 < spread < 0.15
    ends = track.translations - found * float(x.max())
    assert float((ends - grips()).norm(dim=-1).median()) < 0.06
    assert confidence.way == "rod" and np.nanmax(confidence.outline) < 0.03
    assert "about its own axis" in confidence.reason
    turn = track.rotations[1:] @ track.rotations[:-1].mT
    torch.testing.assert_close(torch.linalg.det(track.rotations), torch.ones(FRAMES))
    assert float((turn.diagonal(dim1=-2, dim2=-1).sum(-1) - 1).min() / 2) > 0.8


def test_a_hand_in_the_middle_of_a_rod() -> None:
    track, *_ = rod_object(filmed(back=0.6), 400)
    x = track.points[:, 0]
    assert float(x.max() - x.min()) == pytest.approx(LENGTH + 0.6, abs=0.12)
    way = track.rotations[:, :, 0]
    assert float((way[1:] * way[:-1]).sum(-1).min()) > 0.5  # it never swaps its ends


def test_what_is_broad_or_in_no_hand_is_no_rod() -> None:
    with pytest.raises(UntrackableError, match="as broad as long"):
        rod_object(filmed(radius=0.15), 100)
    shown = filmed()
    assert shown.joints is not None
    shown.joints[...] = torch.tensor([1.5, 1.0, 2.0])
    with pytest.raises(UntrackableError, match="no hand is on its axis"):
        rod_object(shown, 100)


def test_directions_are_carried_without_a_turn_about_them() -> None:
    x, y = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    found = _carried(np.stack((x, x, y, -y, x)))  # the fourth is half a turn away
    np.testing.assert_allclose(found[:, :, 0], np.stack((x, x, y, -y, x)), atol=1e-6)
    np.testing.assert_allclose(
        found @ found.transpose(0, 2, 1), np.tile(np.eye(3), (5, 1, 1)), atol=1e-6
    )
    np.testing.assert_allclose(np.linalg.det(found), 1.0, atol=1e-6)


def test_a_rod_is_taken_for_one() -> None:
    made = make_object(
        None, filmed(), way="auto", radius=None, count=300, progress=lambda done: None
    )
    assert made.confidence.way == "rod" and float(np.nanmean(made.ious)) > 0.5
