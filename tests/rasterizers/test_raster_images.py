"""Pictures of every backend, against formulas and against the oracle."""

from __future__ import annotations

import math

import pytest
import torch
from raster_scenes import (
    CUT,
    Backend,
    a_camera,
    assert_same_picture,
    clear_of_cutoffs,
    front_camera,
    images,
    one_gaussian,
    random_scene,
)

from hoigs.core.gaussians import Gaussians
from hoigs.core.rasterizer import RenderRequest


def test_one_gaussian_is_the_formula(backend: Backend) -> None:
    camera = front_camera(cx=9.0, cy=8.2)
    request = RenderRequest(background=torch.tensor([0.2, 0.3, 0.4]))
    output = backend.render(one_gaussian(), camera, request)
    variance = (20.0 * 0.2 / 2.0) ** 2 + 0.3
    offsets = camera.pixel_grid() - torch.tensor([9.0, 8.2])
    alpha = 0.6 * torch.exp(-0.5 * offsets.square().sum(-1) / variance)
    alpha = torch.where(alpha >= 1 / 255, alpha, 0.0)
    color = alpha[..., None] * torch.tensor([0.9, 0.4, 0.1])
    color = color + (1 - alpha[..., None]) * torch.tensor([0.2, 0.3, 0.4])
    torch.testing.assert_close(output.alpha.cpu(), alpha, atol=1e-5, rtol=0)
    torch.testing.assert_close(output.color.cpu(), color, atol=1e-5, rtol=0)
    torch.testing.assert_close(output.depth.cpu(), 2.0 * alpha, atol=1e-5, rtol=0)
    seen = alpha > 0
    expected = output.expected_depth.cpu()
    torch.testing.assert_close(expected[seen], torch.full_like(alpha, 2.0)[seen])
    assert float(output.info["radii"][0]) == math.ceil(3 * math.sqrt(variance))
    torch.testing.assert_close(output.info["means2d"][0].cpu(), torch.tensor([9.0, 8.2]))
    assert float(output.info["depths"][0]) == pytest.approx(2.0)


def test_the_nearer_hides_the_farther_whatever_their_order(backend: Backend) -> None:
    far = one_gaussian((0, 0, 4), scale=1.0, opacity=0.5, color=(0, 0, 1))
    near = one_gaussian((0, 0, 2), scale=1.0, opacity=0.8, color=(1, 0, 0))
    for parts in ([far, near], [near, far]):
        output = backend.render(Gaussians.cat(parts), front_camera())
        color = output.color[7, 10].cpu()
        torch.testing.assert_close(color, torch.tensor([0.8, 0.0, 0.1]), atol=1e-5, rtol=0)
        assert float(output.depth[7, 10]) == pytest.approx(0.8 * 2 + 0.1 * 4, abs=1e-5)


def test_equal_depths_are_drawn_by_index(backend: Backend) -> None:
    red = one_gaussian(scale=1.0, opacity=0.8, color=(1, 0, 0))
    blue = one_gaussian(scale=1.0, opacity=0.8, color=(0, 0, 1))
    color = backend.render(Gaussians.cat([red, blue]), front_camera()).color[7, 10].cpu()
    torch.testing.assert_close(color, torch.tensor([0.8, 0.0, 0.16]), atol=1e-5, rtol=0)


@pytest.mark.parametrize("seed", [0, 1])
def test_agrees_with_the_oracle(backend: Backend, seed: int) -> None:
    gaussians, camera = random_scene(seed=seed), a_camera()
    generator = torch.Generator().manual_seed(seed)
    request = RenderRequest(
        features=torch.randn(len(gaussians), 5, generator=generator),
        background=torch.rand(camera.height, camera.width, 3, generator=generator),
        screen_offsets=torch.randn(len(gaussians), 2, generator=generator),
    )
    wanted = CUT.render(gaussians, camera, request)
    assert 0.3 < float(wanted.alpha.mean()) < 0.95
    clear = clear_of_cutoffs(gaussians, camera, request)
    output = backend.render(gaussians, camera, request)
    assert_same_picture(output, wanted, clear)
    for name in ("radii", "means2d", "depths"):
        info = output.info[name].double().cpu()
        torch.testing.assert_close(info, wanted.info[name], atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("width, height", [(1, 1), (1, 37), (50, 3), (16, 16), (33, 65)])
def test_any_image_size(backend: Backend, width: int, height: int) -> None:
    gaussians = random_scene(60, degree=0)
    camera = a_camera().resized(width, height)
    wanted = CUT.render(gaussians, camera)
    output = backend.render(gaussians, camera)
    assert output.color.shape == (height, width, 3)
    # few pixels: hold all of them to the tolerance; this seed puts none at a cut-off
    assert_same_picture(output, wanted, torch.ones(height, width, dtype=torch.bool))


@pytest.mark.parametrize("stored", [0, 1, 2, 3])
@pytest.mark.parametrize("active", [0, 1, 2, 3, None])
def test_harmonics_of_every_degree(backend: Backend, stored: int, active: int | None) -> None:
    gaussians, camera = random_scene(40, degree=stored), a_camera(20, 14)
    request = RenderRequest(sh_degree=active)
    wanted = CUT.render(gaussians, camera, request)
    output = backend.render(gaussians, camera, request)
    assert_same_picture(output, wanted, clear_of_cutoffs(gaussians, camera, request))
    if active is not None and active < stored:
        fewer = gaussians.replace(sh=gaussians.sh[:, : (active + 1) ** 2].contiguous())
        torch.testing.assert_close(output.color, backend.render(fewer, camera).color)


def test_features_are_composited_like_colours(backend: Backend) -> None:
    gaussians, camera = random_scene(80, degree=0), a_camera()
    features = torch.cat((gaussians.colors.clamp_min(0), torch.randn(80, 6)), -1)
    output = backend.render(gaussians, camera, RenderRequest(features=features))
    torch.testing.assert_close(output.features[..., :3], output.color, atol=2e-6, rtol=0)
    for channel in range(features.shape[1]):
        single = RenderRequest(features=features[:, channel : channel + 1])
        alone = backend.render(gaussians, camera, single).features[..., 0]
        torch.testing.assert_close(output.features[..., channel], alone, atol=2e-6, rtol=1e-5)


@pytest.mark.parametrize("channels", [0, 1, 17, 40])
def test_any_number_of_feature_channels(backend: Backend, channels: int) -> None:
    gaussians, camera = random_scene(50, degree=0), a_camera(20, 14)
    request = RenderRequest(features=torch.randn(50, channels))
    output = backend.render(gaussians, camera, request)
    assert output.features.shape == (14, 20, channels)
    wanted = CUT.render(gaussians, camera, request)
    if channels:
        assert_same_picture(output, wanted, clear_of_cutoffs(gaussians, camera, request))


def test_subset_draws_only_those(backend: Backend) -> None:
    gaussians, camera = random_scene(90), a_camera()
    mask = torch.rand(90, generator=torch.Generator().manual_seed(5)) < 0.4
    features = torch.randn(90, 3)
    some = backend.render(gaussians, camera, RenderRequest(subset=mask, features=features))
    only = backend.render(gaussians[mask], camera, RenderRequest(features=features[mask]))
    for name, image in images(only).items():
        torch.testing.assert_close(images(some)[name], image, atol=2e-6, rtol=1e-5)
    assert not some.info["radii"][~mask.to(some.alpha.device)].any()
    none = backend.render(gaussians, camera, RenderRequest(subset=torch.zeros(90, dtype=bool)))
    assert not none.alpha.any()


def test_order_of_rows_does_not_matter(backend: Backend) -> None:
    gaussians, camera = random_scene(120), a_camera()
    order = torch.randperm(120, generator=torch.Generator().manual_seed(2))
    a, b = backend.render(gaussians, camera), backend.render(gaussians[order], camera)
    for name, image in images(a).items():
        torch.testing.assert_close(images(b)[name], image, atol=2e-6, rtol=1e-5)
    torch.testing.assert_close(b.info["radii"].cpu(), a.info["radii"].cpu()[order])


def test_background_colour_equals_background_image(backend: Backend) -> None:
    gaussians, camera = random_scene(60, degree=0), a_camera()
    color = torch.tensor([0.1, 0.6, 0.9])
    image = color.expand(camera.height, camera.width, 3).contiguous()
    a = backend.render(gaussians, camera, RenderRequest(background=color))
    b = backend.render(gaussians, camera, RenderRequest(background=image))
    black = backend.render(gaussians, camera)
    torch.testing.assert_close(a.color, b.color)
    under = (1 - black.alpha)[..., None] * color.to(black.color)
    torch.testing.assert_close(a.color, black.color + under, atol=1e-6, rtol=1e-5)


def test_max_alpha_clamps(backend: Backend) -> None:
    solid = one_gaussian(scale=3.0, opacity=0.5)
    solid = solid.replace(opacity_logits=torch.tensor([30.0]))
    for limit in (0.999, 0.99, 0.5):
        output = backend.render(solid, front_camera(), RenderRequest(max_alpha=limit))
        assert float(output.alpha[7, 10]) == pytest.approx(limit, abs=1e-6)
    whole = RenderRequest(max_alpha=1.0, min_transmittance=0.0)
    assert float(backend.render(solid, front_camera(), whole).alpha[7, 10]) == pytest.approx(1.0)


def test_min_alpha_is_the_only_edge_of_a_splat(backend: Backend) -> None:
    """No 3-sigma cut: an opaque splat is seen to where alpha falls to min_alpha."""
    camera = front_camera(61, 61, cx=30.5, cy=30.5)
    splat = one_gaussian(scale=0.6, opacity=0.99)
    variance = (20 * 0.6 / 2) ** 2 + 0.3
    for min_alpha in (1 / 255, 0.05, 1e-4):
        output = backend.render(splat, camera, RenderRequest(min_alpha=min_alpha))
        radius = math.sqrt(2 * math.log(0.99 / min_alpha) * variance)
        distance = (camera.pixel_grid() - 30.5).norm(dim=-1)
        seen = (output.alpha > 0).cpu()
        assert seen[distance < radius - 1e-3].all()
        assert not seen[distance > radius + 1e-3].any()
    unlimited = RenderRequest(min_alpha=0.0, min_transmittance=0.0)
    assert (backend.render(splat, camera, unlimited).color > 0).all()


def test_min_transmittance_leaves_out_the_splat_that_would_cross_it(backend: Backend) -> None:
    layers = [one_gaussian((0, 0, 2 + i), scale=50.0, opacity=0.9) for i in range(5)]
    gaussians, camera = Gaussians.cat(layers), front_camera()
    for limit, drawn in ((0.2, 0), (0.05, 1), (5e-4, 3), (0.0, 5)):
        request = RenderRequest(min_transmittance=limit, min_alpha=1e-6)
        alpha = float(backend.render(gaussians, camera, request).alpha[7, 10])
        assert alpha == pytest.approx(1 - 0.1**drawn, abs=1e-4 * 0.1**drawn + 2e-6)


def test_near_plane(backend: Backend) -> None:
    splat = one_gaussian((0, 0, 0.04), scale=0.004)
    assert not backend.render(splat, front_camera()).alpha.any()
    request = RenderRequest(near=0.03)
    assert float(backend.render(splat, front_camera(), request).alpha.max()) > 0.5


def test_low_pass_is_the_variance_of_a_point(backend: Backend) -> None:
    point = one_gaussian(scale=1e-6, opacity=0.8)
    for low_pass in (0.3, 2.0):
        output = backend.render(point, front_camera(), RenderRequest(low_pass=low_pass))
        wanted = 0.8 * math.exp(-0.5 / low_pass)  # one pixel from the centre
        assert float(output.alpha[7, 11]) == pytest.approx(wanted, rel=1e-5)
        assert float(output.alpha[7, 10]) == pytest.approx(0.8, rel=1e-5)


def test_screen_offsets_move_the_splat(backend: Backend) -> None:
    moved = RenderRequest(screen_offsets=torch.tensor([[3.0, -2.0]]))
    a = backend.render(one_gaussian(), front_camera(), moved).alpha
    b = backend.render(one_gaussian(), front_camera(cx=13.5, cy=5.5)).alpha
    torch.testing.assert_close(a, b, atol=1e-6, rtol=0)


def test_a_cropped_camera_draws_the_crop(backend: Backend) -> None:
    """The principal point is honoured: integer shifts of it shift the picture and nothing else."""
    gaussians, camera = random_scene(100), a_camera()
    gaussians = gaussians.replace(means=gaussians.means * 0.3)  # off the Jacobian's clamp
    whole = backend.render(gaussians, camera).color
    part = backend.render(gaussians, camera.cropped(7, 4, 25, 19)).color
    torch.testing.assert_close(part, whole[4:23, 7:32], atol=2e-5, rtol=0)


@pytest.mark.parametrize("logit", [-20.0, -5.6, 12.0, 40.0])
def test_opacity_near_zero_and_one(backend: Backend, logit: float) -> None:
    gaussians, camera = random_scene(60, degree=0), a_camera()
    gaussians = gaussians.replace(opacity_logits=torch.full((60,), logit))
    request = RenderRequest(min_alpha=1e-3, max_alpha=0.99)
    wanted = CUT.render(gaussians, camera, request)
    output = backend.render(gaussians, camera, request)
    assert_same_picture(output, wanted, clear_of_cutoffs(gaussians, camera, request))
