"""Cameras: axes, pixel centres, round trips, cropping, and that nothing turns into NaN."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from kornia.geometry.camera import project_points

from hoigs.core.errors import CameraError
from hoigs.core.values.camera import Camera, pinhole_pixels, pinhole_rays


def a_camera() -> Camera:
    eye = torch.tensor([1.0, 2.0, -4.0], dtype=torch.float64)
    camera = Camera.look_at(
        eye, torch.tensor([0.0, 0.5, 1.0]).double(), width=64, height=48, fov_y=0.8
    )
    K = camera.K.clone()
    K[:2, 2] = torch.tensor([29.3, 26.1])
    return Camera(K, camera.world_to_camera, 64, 48)


def test_axes_are_opencv() -> None:
    K = torch.tensor([[100.0, 0.0, 32.0], [0.0, 100.0, 24.0], [0.0, 0.0, 1.0]])
    camera = Camera(K, torch.eye(4), 64, 48)
    points = torch.tensor([[0.0, 0.0, 2.0], [0.1, 0.0, 2.0], [0.0, 0.1, 2.0]])
    pixels, depth = camera.project(points)
    torch.testing.assert_close(pixels, torch.tensor([[32.0, 24.0], [37.0, 24.0], [32.0, 29.0]]))
    torch.testing.assert_close(depth, torch.full((3,), 2.0))


def test_look_at_is_rigid_upright_and_centred() -> None:
    eye, target = torch.tensor([3.0, 1.0, -2.0]), torch.tensor([0.5, 0.0, 1.0])
    camera = Camera.look_at(eye, target, width=80, height=60, fov_y=1.0)
    rotation = camera.world_to_camera[:3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3), atol=1e-6, rtol=0)
    assert torch.linalg.det(rotation).item() == pytest.approx(1.0, abs=1e-6)
    torch.testing.assert_close(camera.center, eye)
    pixels, depth = camera.project(torch.stack((target, target + torch.tensor([0.0, 0.2, 0.0]))))
    torch.testing.assert_close(pixels[0], torch.tensor([40.0, 30.0]), atol=1e-4, rtol=0)
    assert depth[0].item() == pytest.approx((target - eye).norm().item(), rel=1e-6)
    assert pixels[1, 1] < 30.0, "up in the world is up in the image"
    assert pixels[1, 0].item() == pytest.approx(40.0, abs=1e-4)
    edge = camera.unproject(torch.tensor([40.0, 0.0]), torch.tensor(1.0)) - eye
    ahead = torch.nn.functional.normalize(target - eye, dim=0)
    assert math.atan2(float((edge - ahead).norm()), 1.0) == pytest.approx(0.5, abs=1e-5)


@pytest.mark.parametrize("target", [(1.0, 5.0, 2.0), (1.0, 1.0, 2.0)])
def test_look_at_without_an_upright_is_refused(target: tuple[float, float, float]) -> None:
    eye = torch.tensor([1.0, 1.0, 2.0])
    with pytest.raises(ValueError, match="up"):
        Camera.look_at(eye, torch.tensor(target), width=8, height=8, fov_y=1.0)


def test_pinholes_agree_with_kornia_and_take_one_camera_for_each_point() -> None:
    camera = a_camera()
    generator = torch.Generator().manual_seed(3)
    points = torch.randn(2, 20, 3, generator=generator).double() + torch.tensor([0, 0, 4.0])
    K = torch.stack((camera.K, camera.resized(32, 24).K))[:, None]
    pixels = pinhole_pixels(K, points)
    torch.testing.assert_close(pixels, project_points(points, K.expand(2, 20, 3, 3)))
    torch.testing.assert_close(pinhole_rays(K, pixels), points[..., :2] / points[..., 2:])
    behind = torch.tensor([[0.1, 0.0, -1.0]]).double().requires_grad_()
    near = pinhole_pixels(camera.K, behind, near=0.1)
    torch.testing.assert_close(near[0, 0], camera.focal[0] + camera.K[0, 2])
    near.sum().backward()
    assert torch.isfinite(behind.grad).all()


def test_which_points_an_image_shows() -> None:
    camera = a_camera()
    pixels = torch.tensor([[0.0, 0.0], [63.9, 47.9], [64.0, 10.0], [-0.1, 10.0], [10.0, 10.0]])
    depth = torch.tensor([1.0, 1.0, 1.0, 1.0, 0.04])
    assert camera.shows(pixels, depth).tolist() == [True, True, False, False, True]
    assert camera.shows(pixels, depth, near=0.05).tolist()[4] is False


def test_unproject_inverts_project() -> None:
    camera = a_camera()
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(5, 7, 3, generator=generator, dtype=torch.float64)
    pixels, depth = camera.project(points)
    torch.testing.assert_close(camera.unproject(pixels, depth), points)


def test_project_is_finite_at_and_behind_the_camera() -> None:
    camera = a_camera()
    ahead = camera.world_to_camera[2, :3]
    points = torch.stack((camera.center, camera.center - ahead)).requires_grad_()
    pixels, depth = camera.project(points)
    assert torch.isfinite(pixels).all()
    assert depth[1].item() == pytest.approx(-1.0)
    pixels[1].sum().backward()
    assert torch.isfinite(points.grad).all()


def test_pixel_centres_are_at_one_half() -> None:
    grid = a_camera().pixel_grid()
    assert grid.shape == (48, 64, 2)
    assert grid[0, 0].tolist() == [0.5, 0.5]
    assert grid[47, 63].tolist() == [63.5, 47.5]
    assert grid[3, 10].tolist() == [10.5, 3.5]


def test_resized_scales_pixels() -> None:
    camera = a_camera()
    point = torch.tensor([[0.1, 0.3, 0.9]], dtype=torch.float64)
    pixels, _ = camera.project(point)
    smaller, _ = camera.resized(32, 12).project(point)
    torch.testing.assert_close(smaller, pixels * torch.tensor([0.5, 0.25]).double())


def test_cropped_shifts_pixels() -> None:
    camera = a_camera()
    point = torch.tensor([[0.1, 0.3, 0.9]], dtype=torch.float64)
    part = camera.cropped(5, 7, 20, 10)
    assert (part.width, part.height) == (20, 10)
    shift = torch.tensor([5.0, 7.0]).double()
    torch.testing.assert_close(part.project(point)[0], camera.project(point)[0] - shift)


def test_gradients_reach_the_pose() -> None:
    base = a_camera()
    points = torch.tensor([[0.2, 0.1, 0.4], [-0.3, 0.6, 1.0]], dtype=torch.float64)

    def project(pose: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, ...]:
        camera = Camera(base.K, pose, 64, 48)
        return (*camera.project(points), camera.center)

    pose = base.world_to_camera.clone().requires_grad_()
    assert torch.autograd.gradcheck(project, (pose, points.requires_grad_()))


def test_to_changes_both_matrices() -> None:
    camera = a_camera().to(torch.float32)
    assert camera.K.dtype == camera.world_to_camera.dtype == torch.float32
    assert (camera.width, camera.height) == (64, 48)


NOT_PINHOLES = [
    ("K", (0, 0), math.nan, r"K\[0, 0\] is nan"),
    ("K", (1, 2), math.inf, r"K\[1, 2\] is inf"),
    ("K", (0, 0), 0.0, r"K has focal lengths of 0 and "),
    ("K", (1, 1), -50.0, r"K has focal lengths of .* and -50 "),
    ("K", (0, 1), 0.5, r"K\[0, 1\] is 0.5"),
    ("K", (1, 0), -0.5, r"K\[1, 0\] is -0.5"),
    ("K", (2, 2), 2.0, r"K\[2\] is \[0.0, 0.0, 2.0\]"),
    ("world_to_camera", (2, 3), math.nan, r"world_to_camera\[2, 3\] is nan"),
    ("world_to_camera", (slice(3), slice(3)), 2.0, r"world_to_camera\[:3, :3\] .* is 3,"),
    ("world_to_camera", 0, -1.0, r"world_to_camera\[:3, :3\] mirrors"),
    ("world_to_camera", (3, 3), 0.5, r"world_to_camera\[3\] is \[0.0, 0.0, 0.0, 0.5\]"),
]


@pytest.mark.parametrize(("field", "place", "value", "says"), NOT_PINHOLES)
def test_what_is_no_pinhole_is_refused(field: str, place: Any, value: float, says: str) -> None:
    camera = a_camera().to(torch.float32)
    wrong = getattr(camera, field).clone()
    # rotations are scaled or mirrored, numbers set
    wrong[place] = wrong[place] * value if wrong[place].dim() else value
    with pytest.raises(CameraError, match=f"Camera.{says}"):
        replace(camera, **{field: wrong})
    # a pose that is learned is not looked at while it is, unless asked
    with pytest.raises(CameraError, match=f"Camera.{says}"):
        replace(camera, **{field: wrong.requires_grad_()}).check()


@pytest.mark.parametrize("wrong", [torch.eye(4)[:3], [[1.0]], None])
def test_shapes_are_refused_by_name(wrong: Any) -> None:
    camera = copy.copy(a_camera())
    object.__setattr__(camera, "world_to_camera", wrong)
    with pytest.raises(CameraError, match=r"world_to_camera is .*expected .*\[4, 4\]"):
        camera.check()


def test_rounding_is_no_mistake() -> None:
    for seed in range(20):
        torch.manual_seed(seed)
        camera = a_camera().moved(torch.randn(3).double(), torch.randn(3).double())
        pose = camera.world_to_camera
        for rounded in (pose.float(), pose.half(), (pose * 1e4).round() / 1e4):
            Camera(camera.K.to(rounded), rounded, 64, 48).resized(640, 480).cropped(3, 4, 5, 6)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_camera_on_a_gpu_is_not_waited_for() -> None:
    camera = a_camera().to("cuda", torch.float32)
    torch.cuda.set_sync_debug_mode("error")
    try:
        wrong = replace(camera, K=camera.K * 2)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    with pytest.raises(CameraError, match=r"Camera.K\[2\]"):
        wrong.check()


def test_rays_go_to_what_pixels_show() -> None:
    camera = a_camera()
    size = (camera.height, camera.width)
    depth = 1 + torch.rand(size, generator=torch.Generator().manual_seed(0)).to(camera.K)
    points = camera.unproject(camera.pixel_grid(), depth) - camera.center
    rays = camera.rays()
    torch.testing.assert_close(rays * points.norm(dim=-1, keepdim=True), points)
    torch.testing.assert_close(camera.cropped(2, 1, 3, 2).rays(), rays[1:3, 2:5])
