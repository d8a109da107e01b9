"""EWA projection against covariances, the camera's own Jacobian, and the rules of culling."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.rasterizers.compositing import project_gaussians


def a_camera() -> Camera:
    eye = torch.tensor([0.8, -0.4, -4.0], dtype=torch.float64)
    camera = Camera.look_at(eye, torch.zeros(3).double(), width=64, height=40, fov_y=0.8)
    K = camera.K * torch.tensor([[1.2], [1.0], [1.0]]).double()
    K[:2, 2] = torch.tensor([27.0, 23.5])
    return Camera(K, camera.world_to_camera, 64, 40)


def a_cloud(count: int = 30, spread: float = 0.5) -> Gaussians:
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    return Gaussians(
        normal(count, 3) * spread,
        normal(count, 4),
        normal(count, 3) * 0.5 - 2,
        normal(count),
        normal(count, 1, 3),
    )


def plain_covariances(gaussians: Gaussians, camera: Camera, low_pass: float) -> Tensor:
    """J Sigma J^T with J by autograd of Camera.project; off the clamp this is EWA splatting."""
    result = []
    for mean, covariance in zip(gaussians.means, gaussians.covariances()):
        jacobian = torch.autograd.functional.jacobian(lambda p: camera.project(p)[0], mean)
        result.append(jacobian @ covariance @ jacobian.mT + low_pass * torch.eye(2).double())
    return torch.stack(result)


@pytest.mark.parametrize("low_pass", [0.0, 0.3, 5.0])
def test_antialiased_opacities_keep_their_sum_over_the_image(low_pass: float) -> None:
    """Mip-Splatting, eq. 9: opacity sqrt(det) is that without the low-pass."""
    gaussians, camera = a_cloud(), a_camera()
    request = RenderRequest(low_pass=low_pass, antialiased=True, min_alpha=0.0)
    shown = project_gaussians(gaussians, camera, request)
    rows = gaussians[shown.index]
    sums = shown.opacities * torch.linalg.det(plain_covariances(rows, camera, low_pass)).sqrt()
    without = torch.linalg.det(plain_covariances(rows, camera, 0.0)).sqrt()
    torch.testing.assert_close(sums, rows.opacities * without)


@pytest.mark.parametrize("low_pass", [0.0, 0.3, 5.0])
def test_means_covariances_and_conics(low_pass: float) -> None:
    gaussians, camera = a_cloud(), a_camera()
    shown = project_gaussians(gaussians, camera, RenderRequest(low_pass=low_pass))
    rows = gaussians[shown.index]
    assert len(shown) > 20
    pixels, depths = camera.project(rows.means)
    torch.testing.assert_close(shown.means2d, pixels)
    torch.testing.assert_close(shown.depths, depths)
    wanted = plain_covariances(rows, camera, low_pass)
    triangle = torch.tensor([0, 1, 3])
    torch.testing.assert_close(shown.covs, wanted.flatten(1)[:, triangle])
    inverse = torch.linalg.inv(wanted).flatten(1)[:, triangle]
    torch.testing.assert_close(shown.conics, inverse)
    largest = torch.linalg.eigvalsh(wanted)[:, 1]
    torch.testing.assert_close(shown.radii, (3 * largest.sqrt()).ceil())
    torch.testing.assert_close(shown.opacities, rows.opacities)


def test_extents_are_the_box_of_the_visible_ellipse() -> None:
    """On the ellipse, alpha is min_alpha; its bounding box is the extents."""
    gaussians, camera = a_cloud(), a_camera()
    shown = project_gaussians(gaussians, camera, RenderRequest(min_alpha=0.02))
    angle = torch.linspace(0, 2 * math.pi, 3601, dtype=torch.float64)
    circle = torch.stack((angle.cos(), angle.sin()), -1)
    for i in range(len(shown)):
        xx, xy, yy = shown.covs[i]
        factor = torch.linalg.cholesky(torch.stack((xx, xy, xy, yy)).reshape(2, 2))
        reach = 2 * torch.log(shown.opacities[i] / 0.02)
        ellipse = reach.sqrt() * circle @ factor.mT
        torch.testing.assert_close(ellipse.max(0).values, shown.extents[i], rtol=1e-5, atol=0)
    free = project_gaussians(gaussians, camera, RenderRequest(min_alpha=0.0))
    assert torch.isinf(free.extents).all()


def test_the_jacobian_is_clamped_as_gsplat_does() -> None:
    """Limits about the principal point: (W - cx) / fx + 0.3 * 0.5 W / fx and its likes."""
    K = torch.tensor([[50.0, 0.0, 10.0], [0.0, 40.0, 30.0], [0.0, 0.0, 1.0]]).double()
    camera = Camera(K, torch.eye(4).double(), 64, 40)
    limits = {
        (+9.0, 0.0): (54 / 50 + 0.3 * 32 / 50, 0.0),
        (-9.0, 0.0): (-10 / 50 - 0.3 * 32 / 50, 0.0),
        (0.0, +9.0): (0.0, 10 / 40 + 0.3 * 20 / 40),
        (0.0, -9.0): (0.0, -30 / 40 - 0.3 * 20 / 40),
        (0.1, -0.2): (0.1, -0.2),
    }
    z, scale = 2.0, 0.3
    for (sx, sy), (tx, ty) in limits.items():
        point = torch.tensor([[sx * z, sy * z, z]]).double()
        gaussians = Gaussians.from_points(point, scales=scale, opacity=0.5)
        request = RenderRequest(min_alpha=0.0)
        shown = project_gaussians(gaussians, camera, request)
        jacobian = torch.tensor([[50 / z, 0, -50 * tx / z], [0, 40 / z, -40 * ty / z]]).double()
        wanted = scale**2 * jacobian @ jacobian.mT + 0.3 * torch.eye(2).double()
        torch.testing.assert_close(shown.covs[0], wanted.flatten()[[0, 1, 3]])
        centre = torch.tensor([50 * sx + 10, 40 * sy + 30]).double()
        torch.testing.assert_close(shown.means2d[0], centre)  # the centre is never clamped


def test_gradients_are_true_on_and_off_the_clamp() -> None:
    base = a_camera()
    gaussians = a_cloud(5, spread=0.3)
    means = torch.cat((gaussians.means, gaussians.means + torch.tensor([9.0, 0.0, 0.0])))
    gaussians = Gaussians.cat([gaussians, gaussians]).replace(means=means)

    def outputs(*x: Tensor) -> tuple[Tensor, ...]:
        camera = Camera(x[6], x[5], base.width, base.height)
        request = RenderRequest(min_alpha=0.0, screen_offsets=x[4])
        cloud = Gaussians(x[0], x[1], x[2], x[3], gaussians.sh)
        shown = project_gaussians(cloud, camera, request)
        assert len(shown) == 10
        return shown.means2d, shown.depths, shown.covs, shown.conics, shown.opacities

    raw = (gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.opacity_logits)
    offsets = torch.zeros(10, 2).double()
    leaves = [x.clone().requires_grad_() for x in (*raw, offsets, base.world_to_camera, base.K)]
    assert torch.autograd.gradcheck(outputs, leaves, atol=1e-5)


def test_determinant_survives_float32_on_needles() -> None:
    """xx yy - xy^2 would cancel to noise for a splat a thousand times longer than wide."""
    quats = torch.tensor([[0.92388, 0.0, 0.0, 0.38268]])  # 45 degrees about the view
    needle = Gaussians(
        torch.tensor([[0.0, 0.0, 2.0]]),
        quats,
        torch.tensor([[1.5, -6.0, -6.0]]),
        torch.zeros(1),
        torch.zeros(1, 1, 3),
    )
    K = torch.tensor([[300.0, 0.0, 32.0], [0.0, 300.0, 32.0], [0.0, 0.0, 1.0]])
    camera = Camera(K, torch.eye(4), 64, 64)
    single = project_gaussians(needle, camera, RenderRequest())
    double = project_gaussians(needle.to(torch.float64), camera.to(torch.float64), RenderRequest())
    assert double.radii[0] > 1500
    torch.testing.assert_close(single.conics.double(), double.conics, rtol=1e-4, atol=0)


CULLED = {
    "behind": {"means": (0.0, 0.0, -1.0)},
    "at the near plane": {"means": (0.0, 0.0, 0.05)},
    "off screen": {"means": (30.0, 0.0, 2.0)},
    "too far": {"means": (0.0, 0.0, 1e11)},
    "not a number": {"means": (math.nan, 0.0, 2.0)},
    "zero quaternion": {"quats": 0.0},
    "tiny quaternion": {"quats": 1e-9},
    "infinite quaternion": {"quats": math.inf},
    "infinite scale": {"log_scales": math.inf},
    "covariance overflows": {"log_scales": 16.0},
    "scale overflows": {"log_scales": 1000.0},
    "scale of zero, written as a logarithm": {"log_scales": -math.inf},
    "transparent": {"opacity_logits": -5.6},
    "colour not finite": {"sh": math.inf},
}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("case", CULLED)
def test_culled(case: str, dtype: torch.dtype) -> None:
    point = torch.tensor([[0.0, 0.0, 2.0]], dtype=dtype)
    good = Gaussians.from_points(point, scales=0.1, opacity=0.5)
    ((name, value),) = CULLED[case].items()
    filled = torch.as_tensor(value, dtype=dtype).expand_as(getattr(good, name))
    bad = good.replace(**{name: filled.clone()})
    both = Gaussians.cat([bad, good]).map(lambda x: x.requires_grad_())
    K = torch.tensor([[50.0, 0.0, 32.0], [0.0, 50.0, 20.0], [0.0, 0.0, 1.0]], dtype=dtype)
    shown = project_gaussians(both, Camera(K, torch.eye(4, dtype=dtype), 64, 40), RenderRequest())
    assert shown.index.tolist() == [1]
    (shown.conics.sum() + shown.means2d.sum() + shown.opacities.sum()).backward()
    for field in ("means", "quats", "log_scales", "opacity_logits"):
        grad = getattr(both, field).grad
        assert torch.isfinite(grad).all() and not grad[0].any(), field


def test_opacity_counts_as_transparent_only_below_min_alpha() -> None:
    faint = Gaussians.from_points(torch.zeros(1, 3).double(), scales=0.1, opacity=0.003)
    assert len(project_gaussians(faint, a_camera(), RenderRequest())) == 0
    assert len(project_gaussians(faint, a_camera(), RenderRequest(min_alpha=0.002))) == 1
    assert len(project_gaussians(faint, a_camera(), RenderRequest(min_alpha=0.0))) == 1


def test_off_screen_is_judged_by_the_visible_ellipse() -> None:
    K = torch.tensor([[50.0, 0.0, 32.0], [0.0, 50.0, 20.0], [0.0, 0.0, 1.0]]).double()
    camera = Camera(K, torch.eye(4).double(), 64, 40)
    sigma = math.sqrt((50 * 0.2 / 2) ** 2 * (1 + 0.832**2) + 0.3)  # clamped slope at x beyond
    for opacity in (0.02, 0.99):
        reach = sigma * math.sqrt(2 * math.log(opacity * 255))
        for beyond, seen in ((reach - 0.1, 1), (reach + 0.1, 0)):
            x = (32 + beyond) / 50 * 2  # the centre stands `beyond` pixels right of the image
            assert x / 2 > 0.832, "the slope is clamped here"
            point = torch.tensor([[x, 0.0, 2.0]]).double()
            cloud = Gaussians.from_points(point, scales=0.2, opacity=opacity)
            assert len(project_gaussians(cloud, camera, RenderRequest())) == seen


def test_subset_features_and_offsets_cull() -> None:
    gaussians, camera = a_cloud(6, spread=0.1), a_camera()
    subset = torch.tensor([True, False, True, True, True, False])
    features, offsets = torch.zeros(6, 2).double(), torch.zeros(6, 2).double()
    features[0, 1] = math.nan
    offsets[2, 0] = math.inf
    offsets[3, 1] = 1e4
    request = RenderRequest(subset=subset, features=features, screen_offsets=offsets)
    assert project_gaussians(gaussians, camera, request).index.tolist() == [4]
    nothing = project_gaussians(gaussians[:0], camera, RenderRequest())
    assert len(nothing) == 0 and nothing.covs.shape == (0, 3)
