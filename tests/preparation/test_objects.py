"""An object's shape, colours and track from masks, hands and a known size."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hoigs.core.camera import Camera
from hoigs.preparation.masks import MaskStack
from hoigs.preparation.object_shape import ColorSampler, inflated_outline, sphere_points
from hoigs.preparation.object_track import apparent_size, hand_depths, held_object
from hoigs.preparation.source import SourceError

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


def test_the_nearest_hand_gives_the_depth() -> None:
    masks, cameras, wrists = held()
    np.testing.assert_allclose(hand_depths(masks, cameras, wrists), 2.0, atol=1e-5)


def test_held_object_projects_onto_its_mask() -> None:
    masks, cameras, wrists = held()
    track, normals, spread = held_object(masks, cameras, wrists, 500)
    assert track.observed.tolist() == [i != 4 for i in range(F)]
    assert track.points.shape == normals.shape and spread < 0.05
    for i in range(F):
        xy, depth = cameras[i].project(track.points + track.translations[i])
        low, high = xy.min(0).values, xy.max(0).values
        expected = torch.tensor([14.0 + 4 * i, 22.0])
        torch.testing.assert_close(low, expected, atol=1.5, rtol=0)
        torch.testing.assert_close(high, expected + 16, atol=1.5, rtol=0)
        assert float(depth.mean()) == pytest.approx(2.0, abs=0.02)
    assert "no rotation" in track.provenance


def test_apparent_size_ignores_masks_that_the_border_cuts() -> None:
    points = (torch.rand(400, 3, generator=torch.Generator().manual_seed(0)) - 0.5) * 0.2
    masks = [square(40, 30, 10), square(40, 30, 10), square(4, 30, 10)[:, :WIDTH]]
    masks[2][:, :14] |= masks[0][:, 30:44]
    shift = torch.tensor([[0.0, 0, 2]]).expand(3, 3)
    size, spread = apparent_size(points, shift, MaskStack(masks), [camera()] * 3)
    assert size == pytest.approx(20 / 10, rel=0.08) and spread == pytest.approx(0, abs=1e-6)


def test_an_object_never_seen_is_refused() -> None:
    masks = MaskStack([np.zeros((HEIGHT, WIDTH), bool)] * F)
    with pytest.raises(SourceError, match="empty in every frame"):
        held_object(masks, *held()[1:], 500)
