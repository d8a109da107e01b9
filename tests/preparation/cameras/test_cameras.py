"""Cameras from COLMAP lose their distortion, and images, masks and points follow alike."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from tiny import FRAMES, HEIGHT, WIDTH

from hoigs.preparation.body.landmarks import Landmarks
from hoigs.preparation.cameras.camera_track import (
    colmap_cameras,
    parallax,
    pinhole,
    static_cameras,
)
from hoigs.preparation.cameras.choose import (
    BesideVideo,
    ChosenCameras,
    choose_cameras,
    without_covered,
)
from hoigs.preparation.estimates.reader import GivenMasks
from hoigs.preparation.mask_stack import MaskStack
from hoigs.preparation.options import PrepareOptions
from hoigs.preparation.video.frames import Choice, VideoFrames
from hoigs.preparation.video.source import SourceError

FOCAL, K1 = 90.0, -0.3


def colmap_model(folder: Path, frames: range = range(FRAMES), k1: float = K1) -> Path:
    """A model of a camera that walks sideways past a row of ten points, written as text."""
    folder.mkdir(parents=True)
    lens = f"1 SIMPLE_RADIAL {WIDTH} {HEIGHT} {FOCAL} {WIDTH / 2} {HEIGHT / 2} {k1}\n"
    (folder / "cameras.txt").write_text(lens)
    lines = [
        f"{i + 1} 1 0 0 0 {-0.1 * i} 0 0 1 frame_{i:05d}.png\n"
        + " ".join(f"{5 + n} {6 + n} {n + 1}" for n in range(10))
        for i in frames
    ]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    tracks = " ".join(f"{i + 1} {{n}}" for i in frames)
    points = [
        f"{n + 1} {0.3 * (n - 4.5)} 0.6 4 255 128 0 0.3 {tracks.format(n=n)}".replace("{n}", str(n))
        for n in range(10)
    ]
    (folder / "points3D.txt").write_text("\n".join(points) + "\n")
    return folder


def test_distortion_is_removed_from_images_masks_and_points(
    tiny_video: Path, tmp_path: Path
) -> None:
    video = VideoFrames(tiny_video)
    track = colmap_cameras(video, colmap_model(tmp_path / "sparse"))
    lens = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT,
        params=[FOCAL, WIDTH / 2, HEIGHT / 2, K1],
    )  # fmt: skip
    # a bright spot where the distorting lens puts a world point
    point = torch.tensor([[-1.2, 0.9, 4.0]])
    spot = np.asarray(lens.img_from_cam(point.double().numpy()))[0]
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    image[(x - spot[0]) ** 2 + (y - spot[1]) ** 2 <= 9] = 255
    expected, _ = track.cameras[0].project(point)
    assert np.abs(expected[0].numpy() - spot).max() > 0.5, "the lens distorts visibly there"

    def center(mask: np.ndarray) -> np.ndarray:
        rows, columns = np.nonzero(mask)
        return np.array([columns.mean() + 0.5, rows.mean() + 0.5])

    straight = track.undistort.image(image)[..., 0] > 127
    np.testing.assert_allclose(center(straight), expected[0], atol=0.4)
    mask = track.undistort.mask(image[..., 0] > 0)
    np.testing.assert_allclose(center(mask), expected[0], atol=0.4)
    moved = track.undistort.pixels(np.array([spot, [np.nan, 1.0]]))
    np.testing.assert_allclose(moved[0], expected[0], atol=1e-3)
    assert np.isnan(moved[1]).all()


def test_poses_points_and_width(tiny_video: Path, tmp_path: Path) -> None:
    model = colmap_model(tmp_path / "sparse")
    track = colmap_cameras(VideoFrames(tiny_video, WIDTH // 2, Choice(every=4)), model)
    assert len(track.cameras) == 3 and not track.metric
    assert float(track.cameras[1].K[0, 0]) == FOCAL / 2
    torch.testing.assert_close(track.cameras[1].center, torch.tensor([0.4, 0, 0]))
    assert track.points.shape == (10, 3)
    torch.testing.assert_close(track.colors[0], torch.tensor([1.0, 128 / 255, 0.0]))
    assert "SIMPLE_RADIAL" in track.provenance


def test_names_with_spaces(tiny_video: Path, tmp_path: Path) -> None:
    """The frame's number stands after one."""
    model = colmap_model(tmp_path / "sparse")
    images = model / "images.txt"
    images.write_text(images.read_text().replace(" frame_", " my frame "))
    track = colmap_cameras(VideoFrames(tiny_video), model)
    places = [float(camera.world_to_camera[0, 3]) for camera in track.cameras]
    assert places == pytest.approx([-0.1 * i for i in range(FRAMES)], abs=1e-6)


def test_points_at_infinity_are_left_out(tiny_video: Path, tmp_path: Path) -> None:
    """Rays that are parallel but for noise meet anywhere, also 1e15 units away."""
    model = colmap_model(tmp_path / "sparse")
    points = model / "points3D.txt"
    first, *rest = points.read_text().splitlines()
    points.write_text("\n".join([first.replace(" 4 255", " 4e15 255"), *rest]) + "\n")
    track = colmap_cameras(VideoFrames(tiny_video), model)
    assert track.points.shape == (9, 3) and track.points.abs().max() < 10


def test_no_distortion_leaves_pixels_alone(tiny_video: Path, tmp_path: Path) -> None:
    track = colmap_cameras(VideoFrames(tiny_video), colmap_model(tmp_path / "sparse", k1=0.0))
    image = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    assert track.undistort.image(image) is image


def test_camera_count_unlike_frame_count(tiny_video: Path, tmp_path: Path) -> None:
    model = colmap_model(tmp_path / "sparse", range(9))
    with pytest.raises(SourceError, match=r"9 .*12 "):
        colmap_cameras(VideoFrames(tiny_video), model)
    assert (
        len(colmap_cameras(VideoFrames(tiny_video, choice=Choice(max_frames=9)), model).cameras)
        == 9
    )


def test_a_damaged_model(tiny_video: Path, tmp_path: Path) -> None:
    model = colmap_model(tmp_path / "sparse")
    (model / "cameras.txt").write_text("1 NO_SUCH_LENS 3 4 5\n")
    with pytest.raises(SourceError, match="COLMAP"):
        colmap_cameras(VideoFrames(tiny_video), model)


def test_static_camera(tiny_video: Path) -> None:
    video = VideoFrames(tiny_video, width=WIDTH // 2)
    given = static_cameras(video, pinhole(video, 120.0))
    assert float(given.cameras[0].K[1, 1]) == pytest.approx(60) and "given" in given.provenance
    assert parallax(given.cameras, torch.tensor([0.0, 0, 3])) == pytest.approx(0, abs=1e-3)


def test_frames_in_which_a_hand_covers_the_lens_are_left_out(
    tiny_video: Path, tmp_path: Path
) -> None:
    """Their masks covered four fifths of the image, and the body followed its neighbours there."""
    video = VideoFrames(tiny_video)
    seen = torch.ones(FRAMES, 33, 3)
    seen[[0, 3, FRAMES - 1]] = torch.nan
    masks = np.zeros((FRAMES, HEIGHT, WIDTH), bool)
    masks[:, : HEIGHT // 3] = True
    masks[[2, FRAMES - 1]] = True  # landmarks were found in the first of these
    landmarks = Landmarks(seen, seen)

    def chosen(masks: np.ndarray) -> ChosenCameras:
        given = GivenMasks(human=MaskStack(masks))
        options = PrepareOptions(camera="static")
        found = choose_cameras(
            video, landmarks, given, BesideVideo(), options, tmp_path, lambda share: None
        )
        return without_covered(found, landmarks, given)

    found = chosen(masks)
    assert found.track.positions == tuple(range(FRAMES - 1))
    assert len(found.track.cameras) == FRAMES - 1
    assert any("left out" in text for text in found.warnings)
    close_up = chosen(np.ones_like(masks))
    assert len(close_up.track.positions) == FRAMES - 3, "three of twelve have no landmarks"
    seen[: FRAMES // 2] = torch.nan
    assert len(chosen(np.ones_like(masks)).track.positions) == FRAMES, "a close-up stays whole"


def test_scaling_the_world_keeps_the_picture(tiny_video: Path, tmp_path: Path) -> None:
    track = colmap_cameras(VideoFrames(tiny_video), colmap_model(tmp_path / "sparse"))
    scaled = [camera.scaled(0.37) for camera in track.cameras]
    for before, after in zip(track.cameras, scaled, strict=True):
        xy, depth = before.project(track.points)
        xy_after, depth_after = after.project(track.points * 0.37)
        torch.testing.assert_close(xy, xy_after, atol=1e-3, rtol=0)
        torch.testing.assert_close(depth * 0.37, depth_after)
    assert parallax(scaled, torch.tensor([0.55 * 0.37, 0, 4 * 0.37])) == pytest.approx(
        15.7, abs=0.2
    )


def test_a_camera_far_beyond_all_others_is_none(tiny_video: Path, tmp_path: Path) -> None:
    model = colmap_model(tmp_path / "sparse")
    text = (model / "images.txt").read_text()
    assert f"{-0.1 * 3} 0 0 1" in text
    (model / "images.txt").write_text(text.replace(f"{-0.1 * 3} 0 0 1", "1e9 0 0 1"))
    found = colmap_cameras(VideoFrames(tiny_video), model, partial=True)
    assert found.positions == tuple(i for i in range(FRAMES) if i != 3)
    assert len(colmap_cameras(VideoFrames(tiny_video), model).cameras) == FRAMES  # the user's own
