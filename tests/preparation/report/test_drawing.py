"""Silhouettes, outlines, points and the video that shows them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from hoigs.core.values.camera import Camera
from hoigs.preparation.body.mask_fit import silhouette
from hoigs.preparation.report.overlay import OverlayVideo, VideoWriter, draw_outline, draw_points
from hoigs.preparation.video.frames import VideoFrames
from hoigs.preparation.video.pictures import shrink, shrink_mask


def camera() -> Camera:
    K = torch.tensor([[100.0, 0, 40], [0, 100.0, 30], [0, 0, 1]])
    return Camera(K, torch.eye(4), 80, 60)


# a unit-square quad, counter-clockwise seen from -z (from the camera at the origin)
QUAD = torch.tensor([[-0.2, -0.1, 2.0], [-0.2, 0.1, 2.0], [0.2, 0.1, 2.0], [0.2, -0.1, 2.0]])
FRONT = torch.tensor([[0, 1, 2], [0, 2, 3]])


def test_silhouette_covers_the_projected_quad() -> None:
    mask = silhouette(QUAD, FRONT, camera())
    expected = np.zeros((60, 80), bool)
    expected[25:35, 30:50] = True
    assert (mask ^ expected).sum() <= 35, "within a pixel of the border"
    assert mask[26:34, 31:49].all()


def test_silhouette_leaves_out_what_faces_away_or_lies_behind() -> None:
    assert not silhouette(QUAD, FRONT.flip(1), camera()).any()
    assert not silhouette(QUAD - torch.tensor([0, 0, 4.0]), FRONT, camera()).any()


def test_outline_and_points() -> None:
    image = np.zeros((60, 80, 3), np.uint8)
    mask = np.zeros((60, 80), bool)
    mask[10:20, 10:20] = True
    draw_outline(image, mask, (1, 2, 3))
    assert (image[10, 10:20] == (1, 2, 3)).all() and not image[12:18, 12:18].any()
    points = torch.tensor([[0.0, 0, 2], [0, 0, -2], [50, 0, 2]])
    draw_points(image, points, camera(), (9, 9, 9))
    assert (image[29:31, 39:41] == 9).all() and (image == 9).all(-1).sum() == 4


def test_a_body_is_faint_where_it_is_hidden(tmp_path: Path) -> None:
    grey, none = np.full((60, 80, 3), 128, np.uint8), np.zeros((60, 80), bool)
    left = none.copy()
    left[:, :40] = True  # of the quad, the right half is behind something
    video = OverlayVideo(tmp_path / "none.mp4", 30, 0, FRONT)
    points = torch.zeros(0, 3)
    drawn = video._draw(grey, camera(), QUAD, left, none, points).astype(int)
    change = np.abs(drawn - 128).sum(-1)[26:34]
    assert 0 < 3 * change[:, 42:49].max() < change[:, 31:38].min()
    unknown = video._draw(grey, camera(), QUAD, none, none, points).astype(int)
    assert (np.abs(unknown - 128).sum(-1)[26:34, 31:49] == change[0, 33]).all()


def test_shrinking() -> None:
    image = np.zeros((4, 6, 3), np.uint8)
    image[:, :3] = 200
    small = shrink(image, 2, 2)
    assert small.shape == (2, 2, 3) and small[0, 0, 0] > 190 and small[0, 1, 0] < 80
    assert shrink_mask(image[..., 0] > 0, 3, 2).tolist() == [[True, False, False]] * 2


def test_video_writer_and_odd_sizes(tmp_path: Path) -> None:
    image = np.full((33, 47, 3), (200, 40, 90), np.uint8)
    with VideoWriter(tmp_path / "a.mp4", fps=24, crf=10) as video:
        for _ in range(5):
            video.add(image)
    read = VideoFrames(tmp_path / "a.mp4")
    assert (len(read), read.width, read.height, read.fps) == (5, 46, 32, 24)
    assert np.abs(next(iter(read)).astype(int) - (200, 40, 90)).max() < 12
