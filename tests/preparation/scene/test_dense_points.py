"""Sparse points filled up along the surfaces that they span."""

from __future__ import annotations

import numpy as np
import torch

from hoigs.core.values.camera import Camera
from hoigs.preparation.scene_points import densify, interpolated_depth, keyframes

WIDTH, HEIGHT = 96, 64


def camera(shift: float = 0.0) -> Camera:
    eye = torch.tensor([shift, 0.0, -3.0])
    return Camera.look_at(
        eye, torch.tensor([shift, 0.0, 0.0]), width=WIDTH, height=HEIGHT, fov_y=0.7
    )


def plane(points: torch.Tensor) -> torch.Tensor:
    """Height above z = 0.4 x - 0.2 y."""
    return points[:, 2] - 0.4 * points[:, 0] + 0.2 * points[:, 1]


def sparse(count: int = 80) -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    xy = (torch.rand(count, 2, generator=generator) - 0.5) * torch.tensor([2.6, 1.8])
    z = 0.4 * xy[:, :1] - 0.2 * xy[:, 1:]
    return torch.cat((xy, z), 1)


def picture() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def test_depth_of_a_slanted_plane_is_exact_under_perspective() -> None:
    view, nothing = camera(), np.zeros((HEIGHT, WIDTH), dtype=bool)
    pixels = np.stack(np.meshgrid(np.arange(20, 70) + 0.5, np.arange(15, 50) + 0.5), -1)
    pixels = pixels.reshape(-1, 2)
    depth = interpolated_depth(sparse(), hidden_by=nothing, camera=view, pixels=pixels)
    known = np.isfinite(depth)
    assert known.mean() > 0.9
    found = view.unproject(
        torch.from_numpy(pixels[known]).float(), torch.from_numpy(depth[known]).float()
    )
    assert plane(found).abs().max() < 1e-4


def test_triangles_across_a_jump_in_depth_say_nothing() -> None:
    points = sparse()
    far = points[:, 0] > 0
    points[far] *= 1  # in place: keep the near half, push the far half away
    points[far, 2] += 6
    points[far, :2] *= 3
    view, nothing = camera(), np.zeros((HEIGHT, WIDTH), dtype=bool)
    pixels = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), -1)
    pixels = pixels.reshape(-1, 2)
    depth = interpolated_depth(points, hidden_by=nothing, camera=view, pixels=pixels)
    found = depth[np.isfinite(depth)]
    assert ((found < 4.5) | (found > 7)).all()


def test_points_lie_on_the_surface_outside_masks_with_its_colours() -> None:
    moving = np.zeros((HEIGHT, WIDTH), dtype=bool)
    moving[20:40, 30:50] = True
    image = np.full((HEIGHT, WIDTH, 3), (10, 200, 60), dtype=np.uint8)
    image[:, ::2] //= 2
    frames = [(image, moving, camera()), (image, moving, camera(0.4))]
    points, colors = densify(sparse(), frames, 1500)
    assert 700 < len(points) <= 2000
    assert plane(points).abs().max() < 1e-3
    xy, _ = camera().project(points)
    hits = moving[xy[:, 1].long().clamp(0, HEIGHT - 1), xy[:, 0].long().clamp(0, WIDTH - 1)]
    # what the first frame hides the second may show, but only beside the mask's middle
    assert hits.mean() < 0.1
    assert torch.allclose(colors[:, 1] / colors[:, 0], torch.full((len(points),), 20.0), atol=0.6)


def test_nothing_is_made_up_without_points_or_room() -> None:
    nothing = np.zeros((HEIGHT, WIDTH), dtype=bool)
    frames = [(picture(), nothing, camera())]
    assert len(densify(sparse(3), frames, 500)[0]) == 0
    assert len(densify(sparse(), frames, 0)[0]) == 0


def test_keyframes_start_in_the_middle() -> None:
    assert keyframes(87)[0] == 43 and set(keyframes(87)) == {0, 22, 43, 64, 86}
    assert keyframes(1) == [0]


def test_points_on_one_line_of_the_image_span_nothing() -> None:
    line = torch.stack([torch.linspace(-1, 1, 9), torch.zeros(9), torch.zeros(9)], 1)
    nothing = np.zeros((HEIGHT, WIDTH), dtype=bool)
    assert len(densify(line, [(picture(), nothing, camera())], 500)[0]) == 0
