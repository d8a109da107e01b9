"""An object's shape, colours and track from masks, hands and a known size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from hoigs.core.interfaces.body import LEFT_WRIST, RIGHT_WRIST
from hoigs.core.values.camera import Camera
from hoigs.preparation.mask_stack import MaskStack, outlines_of
from hoigs.preparation.objects.filmed import Filmed
from hoigs.preparation.objects.registered import registered
from hoigs.preparation.objects.shape import (
    ColorSampler,
    apparent_size,
    hand_depths,
    held_object,
    inflated_outline,
    sphere_points,
)
from hoigs.preparation.video.source import SourceError

WIDTH, HEIGHT, F = 80, 60, 9


def camera(x: float = 0.0) -> Camera:
    K = torch.tensor([[100.0, 0, 40], [0, 100.0, 30], [0, 0, 1]])
    w2c = torch.eye(4)
    w2c[0, 3] = -x
    return Camera(K, w2c, WIDTH, HEIGHT)


def square(x: int, y: int, half: int) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[y - half : y + half, x - half : x + half] = True
    return mask


def test_sphere_is_even_and_of_the_radius() -> None:
    points = sphere_points(500, 0.11)
    torch.testing.assert_close(points.norm(dim=-1), torch.full((500,), 0.11))
    assert float(points.mean(0).norm()) < 1e-3
    nearest = torch.cdist(points, points).fill_diagonal_(9).min(-1).values
    assert float(nearest.max() / nearest.min()) < 1.6


def test_colours_come_from_the_side_that_is_seen() -> None:
    points = sphere_points(400, 0.3)
    sampler = ColorSampler(points, points / 0.3)
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[:, :40], image[:, 40:] = (255, 0, 0), (0, 0, 255)
    disc = np.hypot(*(np.mgrid[:HEIGHT, :WIDTH] - np.array([30, 40])[:, None, None])) < 15
    for spoiled in (False, False, True):  # one frame of three is wrong: the median ignores it
        shown = image[:, ::-1] if spoiled else image
        sampler.add(shown, disc, camera(), torch.eye(3), torch.tensor([0.0, 0, 2]))
    colors = sampler.colors()
    left = (points[:, 0] < -0.06) & (points[:, 2] < -0.1)
    right = (points[:, 0] > 0.06) & (points[:, 2] < -0.1)
    assert (colors[left] == torch.tensor([1.0, 0, 0])).all()
    assert (colors[right] == torch.tensor([0, 0, 1.0])).all()
    behind = colors[points[:, 2] > 0.25]
    assert ((behind == 0) | (behind == 1)).all(), "the far side takes the nearest seen colour"


def test_nothing_seen_is_grey() -> None:
    sampler = ColorSampler(sphere_points(8, 0.1), sphere_points(8, 1.0))
    assert (sampler.colors() == 0.5).all()
    empty = np.zeros((HEIGHT, WIDTH), bool)
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    sampler.add(image, empty, camera(), torch.eye(3), torch.tensor([0.0, 0, 2]))
    assert (sampler.colors() == 0.5).all()


def test_inflated_outline_fills_the_mask_and_faces_outwards() -> None:
    mask = square(50, 30, 10)
    points, normals = inflated_outline(mask, camera(), 2.0, 600)
    xy, depth = camera().project(points)
    column, row = xy.floor().long().numpy().T
    assert mask[row.clip(0, 59), column.clip(0, 79)].mean() > 0.95
    assert float(depth.min()) < 1.96 and float(depth.max()) > 2.04
    assert float(depth.max() - depth.min()) < 0.25, "half as thick as its 0.4 m width"
    front = depth < 1.99
    assert (normals[front, 2] < 0).all() and (normals[depth > 2.01, 2] > 0).all()
    torch.testing.assert_close(normals.norm(dim=-1), torch.ones(len(normals)))


def held() -> tuple[MaskStack, list[Camera], torch.Tensor]:
    """An object that the left hand carries sideways at 2 m; hidden in one frame."""
    masks = [square(22 + 4 * i, 30, 8) for i in range(F)]
    masks[4] = np.zeros_like(masks[4])
    cameras = [camera(0.02 * i) for i in range(F)]
    wrists = torch.stack(
        [
            torch.stack(
                (
                    cameras[i].unproject(torch.tensor([22.0 + 4 * i, 20]), torch.tensor(2.0)),
                    cameras[i].unproject(torch.tensor([5.0, 55]), torch.tensor(3.0)),
                )
            )
            for i in range(F)
        ]
    )
    return MaskStack(masks), cameras, wrists


def filmed(masks: MaskStack, cameras: list[Camera], wrists: torch.Tensor) -> Filmed:
    """Red things before grey, and nobody's pixels."""
    joints = torch.zeros(len(masks), RIGHT_WRIST + 1, 3)
    joints[:, [LEFT_WRIST, RIGHT_WRIST]] = wrists
    images = [np.where(mask[..., None], (200, 40, 30), 90).astype(np.uint8) for mask in masks]
    none = MaskStack([np.zeros((HEIGHT, WIDTH), bool)] * len(masks))
    return Filmed(masks, none, none, cameras, lambda: images, 25.0, joints, (-1,))


def test_the_nearest_hand_gives_the_depth() -> None:
    masks, cameras, wrists = held()
    np.testing.assert_allclose(hand_depths(masks, cameras, wrists), 2.0, atol=1e-5)


def box_of(xy: torch.Tensor) -> torch.Tensor:
    return torch.cat((xy.min(0).values, xy.max(0).values))


def test_held_object_projects_onto_its_mask() -> None:
    masks, cameras, wrists = held()
    track, normals, spread = held_object(filmed(masks, cameras, wrists), 500)
    assert track.observed.tolist() == [i != 4 for i in range(F)]
    assert track.points.shape == normals.shape and spread < 0.05
    for i in range(F):
        world = track.points @ track.rotations[i].mT + track.translations[i]
        xy, depth = cameras[i].project(world)
        expected = torch.tensor([14.0 + 4 * i, 22, 30 + 4 * i, 38])
        torch.testing.assert_close(box_of(xy), expected, atol=1.5, rtol=0)
        assert float(depth.mean()) == pytest.approx(2.0, abs=0.02)
    assert "a weak guess" in track.provenance and not track.rotation_known


def test_size_corrects_hands_that_point_the_wrong_way() -> None:
    """The object comes nearer, from 2.4 to 1.6 m; the fitted wrist stays at 2 m."""
    depths = np.linspace(2.4, 1.6, 2 * F)
    masks = MaskStack([square(40, 30, round(16 / d)) for d in depths])
    wrist = camera().unproject(torch.tensor([[40.0, 20], [5, 55]]), torch.tensor([2.0, 3]))
    track, _, _ = held_object(filmed(masks, [camera()] * 2 * F, wrist.expand(2 * F, 2, 3)), 500)
    found = track.translations[:, 2].numpy()
    assert np.abs(found - 2.0).max() > 0.2, "hands alone would keep it at 2 m"
    assert np.abs(found - depths).max() < 0.22  # masks of whole pixels


def test_roll_follows_the_long_axis() -> None:
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    angles = np.linspace(0.3, 2.2, 2 * F)  # past pi / 2: an axis without a sign
    masks = MaskStack()
    for angle in angles:
        along = (x - 40) * np.cos(angle) + (y - 30) * np.sin(angle)
        across = (y - 30) * np.cos(angle) - (x - 40) * np.sin(angle)
        masks.append((np.abs(along) < 18) & (np.abs(across) < 6))
    # a camera that lies on its side: the roll is about its axis, wherever that points
    side = camera()
    turned = torch.eye(4)
    turned[:3, :3] = torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    side = Camera(side.K, turned, WIDTH, HEIGHT)
    wrist = side.unproject(torch.tensor([[40.0, 20], [5, 55]]), torch.tensor([2.0, 3]))
    track, _, _ = held_object(filmed(masks, [side] * 2 * F, wrist.expand(2 * F, 2, 3)), 800)
    for i in range(1, 2 * F - 1):
        xy, _ = side.project(track.points @ track.rotations[i].mT + track.translations[i])
        column, row = xy.floor().long().numpy().T
        assert masks[i][row, column].mean() > 0.9
    torch.testing.assert_close(
        torch.linalg.det(track.rotations), torch.ones(2 * F), atol=1e-5, rtol=0
    )


def test_a_turn_is_seen_where_the_border_cuts_and_a_hand_hides() -> None:
    """Of a thing that is as broad as long, whose colours and corner say how it lies."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    angles, masks, hands, images = np.linspace(0, 2.6, 2 * F), MaskStack(), MaskStack(), []
    for i, angle in enumerate(angles):
        cx, cy = 40.0, 30.0 - 2.2 * max(0, i - 6)  # out of the picture, at last by more than half
        u = (x - cx) * np.cos(angle) + (y - cy) * np.sin(angle)
        v = (y - cy) * np.cos(angle) - (x - cx) * np.sin(angle)
        thing = (np.abs(u) < 12) & (np.abs(v) < 12) & ~((u > 4) & (v > 4))
        hand = np.hypot(x - cx - 10, y - cy) < 5 * (i > 3)
        image = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
        image[thing] = (200, 40, 30)
        image[thing & (u < 0)] = (40, 60, 190)
        image[hand] = (190, 150, 120)
        masks.append(thing & ~hand)
        hands.append(hand)
        images.append(image)
    wrist = camera().unproject(torch.tensor([[40.0, 20], [5, 55]]), torch.tensor([2.0, 3]))
    shown = filmed(masks, [camera()] * 2 * F, wrist.expand(2 * F, 2, 3))
    shown = replace(shown, humans=hands, images=lambda: images)
    found = registered(shown, outlines_of(masks))
    off = found.angles - angles + angles[found.template]
    off = np.abs((off + np.pi) % (2 * np.pi) - np.pi)
    assert np.degrees(off).max() < 8
    assert np.abs(found.sizes - 1).max() < 0.1 and found.overlaps.min() > 0.8


def test_crumbs_are_no_observation_and_cut_masks_have_no_length() -> None:
    stack = MaskStack(
        [square(40, 30, 10), square(40, 30, 2), square(70, 30, 12), square(40, 30, 9)]
    )
    outlines = outlines_of(stack)
    assert outlines.observed.tolist() == [True, False, True, True]
    assert outlines.whole.tolist() == [True, False, False, True]
    assert np.isfinite(outlines.lengths).tolist() == [True, False, False, True]
    assert outlines.lengths[0] == pytest.approx(4 * 20 / np.sqrt(12), rel=0.01)
    np.testing.assert_allclose(outlines.centers[:2], [[40, 30], [53.0, 30]], atol=2.5)


def test_apparent_size_is_the_median_over_whole_masks() -> None:
    points = (torch.rand(400, 3, generator=torch.Generator().manual_seed(0)) - 0.5) * 0.2
    masks = MaskStack([square(40, 30, 10), square(40, 30, 10), square(74, 30, 14)])
    shift, eyes = torch.tensor([[0.0, 0, 2]]).expand(3, 3), torch.eye(3).expand(3, 3, 3)
    size, spread = apparent_size(points, eyes, shift, masks, outlines_of(masks), [camera()] * 3)
    assert size == pytest.approx(20 / 10, rel=0.08) and spread == pytest.approx(0, abs=1e-6)


def test_an_object_never_seen_is_refused() -> None:
    masks = MaskStack([np.zeros((HEIGHT, WIDTH), bool)] * F)
    with pytest.raises(SourceError, match="every frame"):
        held_object(filmed(masks, *held()[1:]), 500)
