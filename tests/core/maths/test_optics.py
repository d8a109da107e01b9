"""Optics against COLMAP's camera models, the transform's own weights, and finite differences."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from hoigs.core.errors import CameraError, ClipError
from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.core.maths.optics import ALPHA, BETA, KAPPA, Optics, image_points
from hoigs.core.maths.rotations import axis_angle_to_matrices, matrices_to_quats, slerp
from hoigs.core.system.colmap import pycolmap
from hoigs.core.values.between import blend_cameras
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.lens import Lens
from hoigs.rasterizers.compositing import project_gaussians
from hoigs.rasterizers.warp import WarpRasterizer

K = torch.tensor([[55.0, 0.0, 30.0], [0.0, 50.0, 21.0], [0.0, 0.0, 1.0]]).double()
WIDTH, HEIGHT = 64, 40
RADIAL = (-0.28, 0.07, -0.004, 0.02, 0.01, 0.003)
FISHEYE = (0.05, -0.02, 0.01, -0.003)
LENSES = {
    "opencv": Optics(radial=(-0.25, 0.06), tangential=(0.004, -0.006)),
    "full": Optics(radial=RADIAL, tangential=(0.004, -0.006)),
    "prism": Optics(radial=RADIAL, thin_prism=(0.01, -0.004, 0.006, 0.003)),
    "fisheye": Optics("fisheye", radial=FISHEYE),
    "equidistant": Optics("fisheye"),
    "ortho": Optics("ortho"),
    "unscented": Optics(),
}


def pose(turn: tuple[float, ...], shift: tuple[float, ...]) -> Tensor:
    view = torch.eye(4).double()
    view[:3, :3] = axis_angle_to_matrices(torch.tensor(turn).double())
    view[:3, 3] = torch.tensor(shift).double()
    return view


FIRST, LAST = pose((0.1, -0.2, 0.05), (0.1, -0.1, 3.0)), pose((0.16, -0.26, 0.0), (-0.1, 0.05, 3.2))
ROLLING = Optics("fisheye", FISHEYE, shutter="top_to_bottom", last_world_to_camera=LAST)
# up to 25 degrees and half a metre in a frame: some points move against the shutter, and faster
FAST = Optics(
    radial=(-0.2, 0.03),
    shutter="top_to_bottom",
    last_world_to_camera=pose((-0.3, -0.1, 0.2), (0.2, -0.5, 3.1)),
)
ALL = {**LENSES, "rolling": ROLLING, "fast": FAST}


def a_camera(optics: Optics | None) -> Camera:
    focal = torch.tensor([[0.35], [0.35], [1.0]]) if optics and optics.model == "ortho" else 1.0
    intrinsics = K * focal
    intrinsics[:2, 2] = K[:2, 2]
    return Camera(intrinsics, FIRST, WIDTH, HEIGHT, optics)


def a_cloud(count: int = 12, size: float = -2.0) -> Gaussians:
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    means = normal(count, 3) * 0.5
    return Gaussians(
        means, normal(count, 4), normal(count, 3) * 0.4 + size, normal(count), normal(count, 1, 3)
    )


COLMAP = {
    "PINHOLE": (55.0, 50.0, 30.0, 21.0),
    "SIMPLE_RADIAL": (55.0, 30.0, 21.0, -0.2),
    "RADIAL": (55.0, 30.0, 21.0, -0.2, 0.04),
    "OPENCV": (55.0, 50.0, 30.0, 21.0, -0.25, 0.06, 0.004, -0.006),
    "FULL_OPENCV": (55.0, 50.0, 30.0, 21.0, *RADIAL[:2], 0.004, -0.006, *RADIAL[2:]),
    "SIMPLE_RADIAL_FISHEYE": (55.0, 30.0, 21.0, 0.04),
    "RADIAL_FISHEYE": (55.0, 30.0, 21.0, 0.04, -0.03),
    "OPENCV_FISHEYE": (55.0, 50.0, 30.0, 21.0, *FISHEYE),
}


def some_points() -> Tensor:
    """In front of the camera; on its axis and next to it, too."""
    points = torch.randn(400, 3, generator=torch.Generator().manual_seed(1)).double()
    points[:, 2] = points[:, 2].abs() + 0.4
    points[:4, :2] = torch.tensor([[0.0, 0.0], [1e-9, 0.0], [0.0, -1e-4], [3e-3, 4e-3]])
    return points


@pytest.mark.parametrize("model", COLMAP)
def test_places_are_colmaps(model: str) -> None:
    lens = Lens(model, COLMAP[model], WIDTH, HEIGHT)
    points, colmap = (
        some_points(),
        pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=list(COLMAP[model])),
    )
    places, valid = image_points(points, lens.K, lens.optics or Optics())
    wanted = torch.from_numpy(np.asarray(colmap.img_from_cam(points.numpy())))
    assert valid.sum() > 200
    torch.testing.assert_close(places[valid], wanted[valid], atol=1e-9, rtol=1e-12)
    camera = lens.camera(np.eye(4), distorted=True).to(torch.float64)
    pixels, _ = camera.project(points)
    torch.testing.assert_close(pixels[valid], places[valid], atol=1e-3, rtol=1e-6)
    assert lens.camera(np.eye(4)).optics is None


def test_thin_prisms_are_opencvs() -> None:
    """COLMAP's thin prism bends a fisheye; this is OpenCV's formula, written out."""
    points, optics = some_points(), LENSES["prism"]
    x, y = (points[:, :2] / points[:, 2:]).unbind(-1)
    r = x * x + y * y
    plain, valid = image_points(points, K, replace(optics, thin_prism=()))
    s1, s2, s3, s4 = optics.thin_prism
    bent = torch.stack((s1 * r + s2 * r * r, s3 * r + s4 * r * r), -1)
    wanted = plain + bent * torch.tensor([55.0, 50.0])
    torch.testing.assert_close(image_points(points, K, optics)[0][valid], wanted[valid])


def test_a_lens_that_cannot_be_drawn_is_named() -> None:
    with pytest.raises(ClipError, match=r"FOV.*OPENCV_FISHEYE"):
        _ = Lens("FOV", (55.0, 50.0, 30.0, 21.0, 0.9), WIDTH, HEIGHT).optics


def test_beyond_the_radius_where_a_lens_turns_back_nothing_is_shown() -> None:
    for optics in (
        Optics(radial=(-0.3,)),
        Optics(radial=(-0.2, 0.01, 0.0, 0.1, -0.05, -0.01)),
        Optics("fisheye", (-0.1, -0.05)),
    ):
        slopes = torch.linspace(0, 6, 60001).double()
        points = torch.stack((slopes, 0 * slopes, 1 + 0 * slopes), -1)
        places, valid = image_points(points, K, optics)
        grows = places[1:, 0] > places[:-1, 0]
        turns = int((~grows).nonzero()[0])  # the first step back
        assert 0 < turns < 60000
        assert abs(int(valid.sum()) - turns) <= 1 and valid[: turns - 1].all()
        edge = float(slopes[turns])
        means = torch.tensor([[edge * 0.95, 0, 1], [edge * 1.05, 0, 1], [0, 0, 1]]).double()
        camera = replace(a_camera(optics), world_to_camera=torch.eye(4).double(), width=4000)
        shown = project_gaussians(
            Gaussians.from_points(means, scales=1e-3), camera, RenderRequest()
        )
        assert shown.index.tolist() == [0, 2]
    assert Optics("fisheye").largest_slope == Optics(radial=(0.1,)).largest_slope == math.inf


def test_a_fisheye_sees_almost_half_of_all_directions() -> None:
    """90 degrees to the side, COLMAP's place for it; behind that nothing."""
    angle = torch.tensor([0.0, 60.0, 89.0, 91.0, 180.0]).double().deg2rad()
    means = 4.0 * torch.stack((angle.sin(), 0 * angle, angle.cos()), -1)
    view = Camera(K * 0.3 + 0.7 * torch.eye(3), torch.eye(4).double(), 64, 40, Optics("fisheye"))
    shown = project_gaussians(Gaussians.from_points(means, scales=0.01), view, RenderRequest())
    assert shown.index.tolist() == [0, 1, 2]
    torch.testing.assert_close(
        shown.means2d[:, 0], view.K[0, 0] * angle[:3] + view.K[0, 2], atol=2e-4, rtol=0
    )
    pixels, depth = view.project(means)
    assert pixels[3:].isnan().all() and pixels[:3].isfinite().all() and (depth[3:] < 0).all()


@pytest.mark.parametrize("name", ALL)
def test_gaussians_are_the_weighted_sums_of_seven_points(name: str) -> None:
    camera, cloud = a_camera(ALL[name]), a_cloud()
    shown = project_gaussians(cloud, camera, RenderRequest(low_pass=0.1))
    assert len(shown) >= 8
    rows = cloud[shown.index]
    spread = ALPHA**2 * (3 + KAPPA)
    weight = torch.full((7,), 0.5 / spread, dtype=torch.float64)
    weight[0] = 1 - 3 / spread
    for_cov = weight.clone()
    for_cov[0] += 1 - ALPHA**2 + BETA
    turns = torch.linalg.eigh(rows.covariances())  # the points are on the axes
    roots = (turns.eigenvectors * turns.eigenvalues.sqrt()[:, None]).mT * math.sqrt(spread)
    mean = rows.means[:, None]
    places, _ = camera.project(torch.cat((mean, mean + roots, mean - roots), 1))
    centre = (weight[:, None] * places).sum(1)
    off = places - centre[:, None]
    cov = torch.einsum("p,npi,npj->nij", for_cov, off, off) + 0.1 * torch.eye(2).double()
    torch.testing.assert_close(shown.means2d, centre, atol=1e-8, rtol=0)
    torch.testing.assert_close(shown.covs, cov.flatten(1)[:, [0, 1, 3]], atol=1e-7, rtol=1e-7)
    inverse = torch.linalg.inv(cov).flatten(1)[:, [0, 1, 3]]
    torch.testing.assert_close(shown.conics, inverse, atol=1e-7, rtol=1e-6)


def test_small_gaussians_are_those_of_the_jacobian() -> None:
    cloud = a_cloud(size=-6.0)
    for name, optics in ALL.items():
        camera = a_camera(optics)
        shown = project_gaussians(cloud, camera, RenderRequest(low_pass=0.0, min_alpha=0.0))
        rows = cloud[shown.index]
        for i, (mean, sigma) in enumerate(zip(rows.means, rows.covariances())):
            J = torch.autograd.functional.jacobian(lambda p, c=camera: c.project(p)[0], mean)
            cov = (J @ sigma @ J.mT).flatten()[[0, 1, 3]]
            scale = float(cov.abs().max())
            assert (shown.covs[i] - cov).abs().max() < 2e-3 * scale, name
    exact, ewa = (project_gaussians(cloud, a_camera(o), RenderRequest()) for o in (Optics(), None))
    torch.testing.assert_close(exact.means2d, ewa.means2d, atol=1e-3, rtol=0)
    torch.testing.assert_close(exact.opacities, ewa.opacities)


@pytest.mark.parametrize("last", [LAST, FAST.last_world_to_camera], ids=["slow", "fast"])
@pytest.mark.parametrize(
    "shutter", ["top_to_bottom", "bottom_to_top", "left_to_right", "right_to_left"]
)
def test_each_row_is_seen_from_the_pose_at_its_time(shutter: str, last: Tensor) -> None:
    optics = Optics(radial=(-0.2, 0.03), shutter=shutter, last_world_to_camera=last)
    camera, points = a_camera(optics), a_cloud(40).means
    pixels, depths = camera.project(points)
    with torch.inference_mode():
        assert torch.equal(camera.project(points)[0], pixels)
    axis, size = (0, WIDTH) if "left" in shutter else (1, HEIGHT)
    time = ((pixels[:, axis] - 0.5) / (size - 1)).clamp(0, 1)
    if shutter in ("bottom_to_top", "right_to_left"):
        time = 1 - time
    assert time.std() > 0.1 and pixels.isfinite().all()
    ends = [matrices_to_quats(view[:3, :3]) for view in (FIRST, last)]
    still = replace(optics, shutter="global", last_world_to_camera=None)
    for point, pixel, depth, tau in zip(points, pixels, depths, time):
        for at, want in ((tau, pixel), (torch.tensor(0.5), None)):
            quat = slerp(*ends, at)
            view = torch.eye(4).double()
            view[:3, :3] = torch.stack([turned(quat, e) for e in torch.eye(3).double()], 1)
            view[:3, 3] = (1 - at) * FIRST[:3, 3] + at * last[:3, 3]
            found, z = replace(camera, world_to_camera=view, optics=still).project(point)
            if want is not None:
                torch.testing.assert_close(found, want, atol=1e-7, rtol=0)
            else:
                torch.testing.assert_close(z, depth, atol=2e-4, rtol=0)


def test_a_point_that_moves_as_fast_as_the_shutter_has_no_place() -> None:
    """The first point stays a row below the one that is exposed; the second one is far off."""
    K = a_camera(None).K
    z = 1.96 * K[1, 1] / (HEIGHT - 1)  # where 2 m are as many pixels as the shutter passes, and 2 %
    y = (0.5 * HEIGHT + 0.8 - K[1, 2]) * z / K[1, 1] - 1.0
    means = torch.stack((0 * z, y, z, 0.3 + 0 * z, 0 * z, 3 * z)).reshape(2, 3)
    optics = Optics(
        shutter="top_to_bottom", last_world_to_camera=pose((0.0, 0.0, 0.0), (0.0, 2.0, 0.0))
    )
    camera = Camera(K, torch.eye(4).double(), WIDTH, HEIGHT, optics)
    assert camera.project(means)[0].isnan().all(-1).tolist() == [True, False]
    cloud = Gaussians.from_points(means, scales=1e-3)
    assert project_gaussians(cloud, camera, RenderRequest()).index.tolist() == [1]
    drawn = WarpRasterizer().render(cloud.map(Tensor.float), camera.to(torch.float32))
    assert (drawn.info["radii"] > 0).tolist() == [False, True]


def test_points_at_a_phones_motion_take_few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    last = pose((0.02, 0.02, 0.02), (0.01, 0.01, 2.01))  # 2 degrees and 2 cm
    optics = replace(ROLLING, last_world_to_camera=last)
    camera = replace(a_camera(optics), world_to_camera=pose((0.0, 0.0, 0.0), (0.0, 0.0, 2.0)))
    looked_at, places = [], image_points

    def counted(points: Tensor, *camera: object) -> tuple[Tensor, Tensor]:
        looked_at.append(points[..., 0].numel())
        return places(points, *camera)

    monkeypatch.setattr("hoigs.core.maths.optics.image_points", counted)
    assert camera.project(a_cloud(100).means)[0].isfinite().all()
    assert sum(looked_at) <= 4 * 100  # three steps, and the place at the end


def turned(quat: Tensor, vector: Tensor) -> Tensor:
    """q v q*, written out."""
    w, axis = quat[0], quat[1:]
    t = 2 * torch.linalg.cross(axis, vector)
    return vector + w * t + torch.linalg.cross(axis, t)


@pytest.mark.parametrize("name", ALL)
def test_gradients_are_true(name: str) -> None:
    """Of every field, the pose and the last pose, in the image centre too."""
    base, cloud = a_camera(ALL[name]), a_cloud(4)
    middle = base.middle.world_to_camera
    means = cloud.means.clone()
    means[0] = middle[:3, :3].mT @ (torch.tensor([0.0, 0.0, 3.0]) - middle[:3, 3])

    def outputs(*x: Tensor) -> tuple[Tensor, ...]:
        optics = base.optics
        if len(x) > 7:
            optics = replace(optics, last_world_to_camera=x[7])
        camera = Camera(x[6], x[5], WIDTH, HEIGHT, optics)
        request = RenderRequest(min_alpha=0.0, screen_offsets=x[4], antialiased=True)
        shown = project_gaussians(Gaussians(*x[:4], cloud.sh), camera, request)
        assert len(shown) == 4
        return shown.means2d, shown.depths, shown.covs, shown.conics, shown.opacities

    offsets = torch.zeros(4, 2).double()
    raw = (means, cloud.quats, cloud.log_scales, cloud.opacity_logits, offsets)
    leaves = [*raw, base.world_to_camera, base.K]
    leaves += [base.optics.last_world_to_camera] if base.middle is not base else []
    leaves = [x.clone().requires_grad_() for x in leaves]
    assert torch.autograd.gradcheck(outputs, leaves, atol=1e-5, fast_mode=True)


def test_what_has_no_place_is_culled() -> None:
    """Behind the camera, nearer than `near` at one of seven points, and not finite."""
    means = torch.tensor([[0, 0, 2], [0, 0, -2], [0, 0, 0.06], [0, 0, 0.06], [0, 0, 2]]).double()
    means[4, 0] = math.nan
    scales = torch.tensor([0.1, 0.1, 0.01, 0.2, 0.1]).double()[:, None].expand(5, 3)
    for optics in LENSES.values():
        camera = replace(a_camera(optics), world_to_camera=torch.eye(4).double())
        cloud = Gaussians.from_points(means, scales=0.1).replace(log_scales=scales.log())
        leaves = cloud.map(lambda x: x.clone().requires_grad_())
        shown = project_gaussians(leaves, camera, RenderRequest())
        assert shown.index.tolist() == [0, 2]
        (shown.conics.sum() + shown.means2d.sum()).backward()
        assert leaves.means.grad.isfinite().all() and not leaves.means.grad[[1, 3, 4]].any()


def test_cameras_with_optics_move_and_scale_whole() -> None:
    points = a_cloud(20).means
    for optics in ALL.values():
        camera = a_camera(optics)
        pixels, depth = camera.project(points)
        larger, far = camera.scaled(2.0).project(2.0 * points)
        torch.testing.assert_close(larger, pixels, atol=1e-6, rtol=0)
        torch.testing.assert_close(far, 2.0 * depth)
        moved = camera.moved(torch.tensor([0.0, 0.0, 0.3]).double(), torch.zeros(3).double())
        torch.testing.assert_close(moved.project(points)[1], depth, atol=1e-9, rtol=0)
        with pytest.raises(CameraError, match="unproject is for pinholes"):
            camera.unproject(pixels, depth)
    with pytest.raises(CameraError, match="rolling"):
        a_camera(ROLLING).cropped(0, 0, 9, 9)
    with pytest.raises(CameraError, match="blend_cameras"):
        blend_cameras(a_camera(None), a_camera(ROLLING), 0.5)
    assert a_camera(ROLLING).to(torch.float32).optics.last_world_to_camera.dtype == torch.float32


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"model": "fishy"}, r"fishy.*fisheye"),
        ({"shutter": "rolling"}, "shutter"),
        ({"shutter": "top_to_bottom"}, "last_world_to_camera is None"),
        ({"last_world_to_camera": torch.eye(4)}, "last_world_to_camera is not None"),
        ({"model": "fisheye", "radial": (0.0,) * 6}, "at most 4"),
        ({"model": "fisheye", "tangential": (0.1, 0.0)}, "tangential"),
        ({"radial": (math.nan,)}, "radial"),
    ],
)
def test_optics_that_do_not_exist_are_named(wrong: dict, named: str) -> None:
    with pytest.raises(CameraError, match=named):
        Optics(**wrong)


def test_a_broken_last_pose_is_named() -> None:
    with pytest.raises(CameraError, match=r"optics\.last_world_to_camera"):
        a_camera(replace(ROLLING, last_world_to_camera=2.0 * LAST))
