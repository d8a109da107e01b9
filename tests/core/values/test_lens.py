"""Lens and Undistortion: distortion is removed, and what the lens does not show is known."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from kornia.geometry.calibration import distort_points

from hoigs.core.errors import ClipError
from hoigs.core.values.lens import Lens

SIZE = (48, 40)
K = np.array([[40.0, 0, 26.5], [0, 42.0, 18.25], [0, 0, 1]])


def opencv_pixels(xy: np.ndarray, d: list[float]) -> np.ndarray:
    """Rays to pixels through OpenCV's lens, by kornia."""
    straight = xy.reshape(1, -1, 2) * [K[0, 0], K[1, 1]] + K[:2, 2]
    tensors = map(torch.from_numpy, (straight, K[None], np.array([d])))
    return distort_points(*tensors).numpy().reshape(xy.shape)


def painting(xy: np.ndarray) -> np.ndarray:
    """A smooth picture, RGB 0..255, of positions on the plane z = 1."""
    waves = np.stack((np.sin(7 * xy[..., 0]), np.cos(6 * xy[..., 1]), np.sin(5 * xy.sum(-1))), -1)
    return 127.5 + 120 * waves


def rays_through_bent(d: list[float]) -> np.ndarray:
    """Rays of the pixel centres of a distorted image, by fixed-point iteration."""
    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    pixels = np.stack((x, y), -1)
    focal, rays = np.array([K[0, 0], K[1, 1]]), (pixels - K[:2, 2]) / [K[0, 0], K[1, 1]]
    for _ in range(60):
        rays = rays - (opencv_pixels(rays, d) - pixels) / focal
    assert np.abs(opencv_pixels(rays, d) - pixels).max() < 1e-6
    return rays


@pytest.mark.parametrize(
    "distortion",
    [[-0.12, 0.02, 0.003, -0.002], [-0.1, 0.01, 0.0, 0.001, 0.004],
     [-0.15, 0.01, 0.003, 0.002, 0.01, 0.08, 0.01, 0.002]],
)  # fmt: skip
def test_images_and_depth_are_straightened(distortion: list[float]) -> None:
    lens = Lens.opencv(K, distortion, *SIZE)
    bent = painting(rays_through_bent(distortion))
    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    straight = painting((np.stack((x, y), -1) - K[:2, 2]) / [K[0, 0], K[1, 1]])
    flat = lens.undistortion()
    seen = np.ones(straight.shape[:2], bool) if flat.outside is None else ~flat.outside
    seen[[0, -1]] = seen[:, [0, -1]] = False  # between a border pixel's centre and the border
    image = flat.image(bent.round().astype(np.uint8)).astype(float)
    assert np.abs(image - straight)[seen].mean() < 1.5
    assert np.abs(bent - straight)[seen].mean() > 3, "the distortion matters"
    depth = flat.depth(bent[..., 0].astype(np.float32))
    assert np.abs(depth - straight[..., 0])[seen].max() < 25, "at most a pixel's change"


def test_opencv_centres_are_shifted() -> None:
    assert Lens.opencv(K, (), *SIZE, pixel_center=0.0).K[0, 2] == 27.0
    assert Lens.opencv(K, (), *SIZE).K[0, 2] == 26.5
    assert Lens.opencv(K, (), *SIZE).model == "PINHOLE"


def test_what_a_barrel_lens_does_not_show_is_outside() -> None:
    flat = Lens.opencv(K, [0.3, 0, 0, 0], *SIZE).undistortion()
    assert flat.outside is not None and flat.outside[0, 0] and not flat.outside[20, 24]
    white = np.full((SIZE[1], SIZE[0]), 2.0, np.float32)
    assert (flat.depth(white)[flat.outside] == 0).all()
    assert not flat.mask(white > 1)[flat.outside].any()


def test_a_polynomial_that_turns_back_shows_nothing_there() -> None:
    lens = Lens.opencv(np.array([[12.0, 0, 24], [0, 12.0, 20], [0, 0, 1]]), [-0.3, 0, 0, 0], *SIZE)
    outside = lens.undistortion().outside
    x, y = np.meshgrid((np.arange(48) - 23.5) / 12, (np.arange(40) - 19.5) / 12)
    beyond = x**2 + y**2 > 1 / 0.9 + 0.1  # d/dr of r - 0.3 r^3 is zero at r^2 = 1 / 0.9
    assert outside is not None and outside[beyond].all()


def test_positions_go_the_same_way() -> None:
    distortion = [-0.12, 0.02, 0.003, -0.002]
    rays = np.array([[0.1, -0.2], [-0.4, 0.3], [np.nan, 0.0]])
    there = Lens.opencv(K, distortion, *SIZE).undistortion()
    back = there.pixels(opencv_pixels(rays, distortion))
    want = rays * [K[0, 0], K[1, 1]] + K[:2, 2]
    assert np.abs(back[:2] - want[:2]).max() < 1e-6 and np.isnan(back[2]).all()


@pytest.mark.parametrize("distortion", [[-0.2, 0.03, 0.0, 0.01], [0.2, 0.0, 0.0, 0.0]])
def test_an_image_with_margins_shows_all_of_the_frame(distortion: list[float]) -> None:
    lens = Lens.opencv(K, distortion, *SIZE)
    margins = lens.margins(SIZE)
    assert any(margins) == (distortion[0] < 0)
    left, top, right, bottom = margins
    whole, plain = lens.undistortion(margins=margins), lens.undistortion()
    large = np.array([SIZE[0] + left + right, SIZE[1] + top + bottom])
    edges = np.array([[0, 0], [48, 0], [0, 40], [48, 40], [24, 0], [48, 20], [24, 40], [0, 20.0]])
    places = whole.pixels(edges)
    assert (places > -1e-3).all() and (places < large + 1e-3).all()
    np.testing.assert_allclose(places, plain.pixels(edges) + np.array([left, top]), atol=1e-9)
    frame = np.random.default_rng(0).integers(0, 255, (SIZE[1], SIZE[0], 3), np.uint8)
    inner = slice(top, top + SIZE[1]), slice(left, left + SIZE[0])
    assert whole.image(frame).shape == (large[1], large[0], 3)
    assert (whole.image(frame)[inner] == plain.image(frame)).all() and whole.shift == plain.shift
    assert whole.mask(frame[..., 0] > 99).shape == (large[1], large[0])


def test_margins_are_at_most_half_of_the_frame() -> None:
    fisheye = Lens("OPENCV_FISHEYE", (12.0, 12.0, 24.0, 20.0, 0.0, 0.0, 0.0, 0.0), *SIZE)
    assert fisheye.margins(SIZE) == (24, 20, 24, 20)  # the corners are 150 degrees off the axis
    assert Lens("PINHOLE", (12.0, 12.0, 24.0, 20.0), *SIZE).margins(SIZE) == (0, 0, 0, 0)


def test_resized() -> None:
    half = Lens.opencv(K, [0.1, 0, 0, 0], *SIZE).resized(24, 20)
    assert torch.allclose(half.K[:2], torch.from_numpy(K[:2] / 2)) and half.params[4] == 0.1


def test_unusable_lenses_are_named() -> None:
    with pytest.raises(ClipError, match='not a camera model of COLMAP; did you mean "PINHOLE"'):
        Lens("PINHOL", (1.0, 1.0, 1.0, 1.0), 8, 8)
    with pytest.raises(ClipError, match="got 1"):
        Lens("OPENCV", (1.0,), 8, 8)
    with pytest.raises(ClipError, match="7 distortion coefficients"):
        Lens.opencv(K, [0.1] * 7, *SIZE)
