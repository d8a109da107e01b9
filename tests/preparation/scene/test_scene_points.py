"""A static background: a plate without the person, and points on a supposed floor and wall."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny import FRAMES, HEIGHT, WIDTH, background, masks, picture

from hoigs.core.values.camera import Camera
from hoigs.preparation.scene_points import (
    PlateView,
    background_plate,
    plate_points,
    quadtree,
    supposed_depth,
)
from hoigs.preparation.video.source import SourceError


def camera() -> Camera:
    K = torch.tensor([[80.0, 0, WIDTH / 2], [0, 80.0, HEIGHT / 2], [0, 0, 1]])
    return Camera(K, torch.eye(4), WIDTH, HEIGHT)


def test_plate_shows_what_is_behind_the_ball() -> None:
    plate = background_plate(((picture(i), np.logical_or(*masks(i))) for i in range(FRAMES)), 1)
    person = masks(0)[0] & masks(FRAMES - 1)[0]
    assert not plate.seen[person].any(), "always covered by the person"
    np.testing.assert_array_equal(plate.image[plate.seen], background()[plate.seen])
    assert plate.seen.mean() > 0.75
    assert np.abs(plate.image.astype(int) - background())[~plate.seen].mean() < 15  # neighbours


def test_floor_then_wall() -> None:
    pixels = torch.tensor([[48.0, 64], [48, 48], [48, 33], [48, 10]])
    depth = supposed_depth(camera(), 1.5, 7.0, pixels)
    torch.testing.assert_close(depth, torch.tensor([3.75, 7.0, 7.0, 7.0]))
    floor = camera().unproject(pixels[:1], depth[:1])
    assert float(floor[0, 1]) == pytest.approx(1.5), "the floor is 1.5 m below the camera"


def test_points_lie_under_their_pixels_with_their_colours() -> None:
    plate = background_plate([(background(), np.zeros((HEIGHT, WIDTH), bool))], 0)
    points, colors = plate_points(plate, camera(), ground=1.5, backdrop=7.0, count=600)
    assert points.shape == colors.shape and 600 <= len(points) <= 603
    xy, depth = camera().project(points)
    assert float(depth.min()) > 0 and float(depth.max()) <= 7
    column, row = xy.floor().long().numpy().T
    expected = background()[row, column] / 255
    assert np.abs(colors.numpy() - expected).max() < 0.03


def test_quadtree_tiles_the_image_and_goes_where_the_detail_is() -> None:
    image = np.full((40, 52, 3), 90, np.uint8)
    image[:20, :20] = np.random.default_rng(0).integers(0, 255, (20, 20, 3))
    cells = quadtree(image, 200)
    covered = np.zeros((40, 52), int)
    for y, x, h, w in cells:
        covered[y : y + h, x : x + w] += 1
    assert (covered == 1).all() and 200 <= len(cells) <= 203
    busy = sum(y < 20 and x < 20 for y, x, _, _ in cells)
    assert busy > 0.85 * len(cells), "a flat area needs few cells"
    assert all(min(h, w) == 1 for _, _, h, w in quadtree(image, 10**6)), "no more than pixels"


def turned(degrees: float) -> Camera:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    pose = torch.eye(4)
    pose[:3, :3] = torch.tensor([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    return replace(camera(), world_to_camera=pose)


def test_the_plate_of_a_camera_that_turns_shows_what_any_frame_shows() -> None:
    """Frames that show the azimuth of their pixels in red are one picture of it."""
    cameras = [turned(d) for d in (-12.0, 0.0, 12.0)]
    view = PlateView.of(cameras)
    shown = []
    for c in cameras:
        rays = c.unproject(c.pixel_grid(), torch.ones(HEIGHT, WIDTH))
        azimuth = torch.rad2deg(torch.atan2(rays[..., 0], rays[..., 2]))
        image = torch.stack([(azimuth + 60) * 2] * 3, -1).round().byte().numpy()
        shown.append(view.carried(image, np.zeros((HEIGHT, WIDTH), bool), c))
    plate, within = background_plate(shown, 0), view.within(cameras)
    assert view.camera.width > WIDTH and 0.7 < within.mean() < 1
    assert plate.seen[within].mean() > 0.98 and not plate.seen[~within].all()
    grid = view.camera.pixel_grid()
    rays = view.camera.unproject(grid, torch.ones(grid.shape[:2]))
    azimuth = torch.rad2deg(torch.atan2(rays[..., 0], rays[..., 2])).numpy()
    inner = plate.seen & within
    assert np.abs(plate.image[..., 0] / 2 - 60 - azimuth)[inner].max() < 1.5
    points, _ = plate_points(plate, view.camera, ground=1.5, backdrop=7.0, count=600, within=within)
    seen = torch.stack([c.shows(*c.project(points)) for c in cameras])
    assert seen.any(0).float().mean() > 0.98
    with pytest.raises(SourceError, match="degrees"):
        PlateView.of([turned(-60.0), turned(60.0)])
