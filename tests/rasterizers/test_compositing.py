"""The shared pieces of the torch backends, against their literal definitions."""

from __future__ import annotations

import pytest
import torch
from raster_scenes import CUT, a_camera, images, random_scene

from hoigs.core.errors import RenderError
from hoigs.core.interfaces.rasterizer import Rasterizer, RenderRequest
from hoigs.core.values.gaussians import Gaussians
from hoigs.rasterizers import compositing
from hoigs.rasterizers.compositing import compositing_weights, prepare, splat_alphas
from hoigs.rasterizers.oracle import OracleRasterizer
from hoigs.rasterizers.torch_tiles import TorchRasterizer, tile_intersections
from hoigs.rasterizers.warp import WarpRasterizer
from hoigs.testing.rasterizer import CHECKS, RasterizerSubject


@pytest.mark.parametrize("limit", [0.0, 1e-4, 0.03, 0.5])
def test_weights_are_the_loop_front_to_back(limit: float) -> None:
    generator = torch.Generator().manual_seed(0)
    alphas = torch.rand(20, 9, generator=generator, dtype=torch.float64)
    alphas[3, 4] = 0.0
    alphas[5, 2] = 1.0
    wanted = torch.zeros_like(alphas)
    for row in range(20):
        transmittance = 1.0
        for i in range(9):
            after = transmittance * (1 - float(alphas[row, i]))
            if limit > 0 and after <= limit:
                break
            wanted[row, i] = transmittance * alphas[row, i]
            transmittance = after
    torch.testing.assert_close(compositing_weights(alphas, limit), wanted)
    assert compositing_weights(alphas[:, :0], limit).shape == (20, 0)


@pytest.mark.parametrize("min_alpha", [0.0, 1 / 255, 0.1])
@pytest.mark.parametrize("tile_size", [1, 7, 16, 100])
def test_tiles_list_every_splat_that_touches_a_pixel(tile_size: int, min_alpha: float) -> None:
    camera = a_camera()
    request = RenderRequest(min_alpha=min_alpha)
    splats, _ = prepare(random_scene(80, degree=0), camera, request)
    tiles, rows = tile_intersections(splats, camera, tile_size, min_alpha)
    tiles_x = -(-camera.width // tile_size)
    listed = tiles * len(splats) + rows
    assert (listed.diff() > 0).all(), "tiles ascend, and the splats of each are in depth order"
    grid = camera.pixel_grid().flatten(0, 1)
    pixel, row = torch.nonzero(splat_alphas(grid, splats, 0.999, min_alpha), as_tuple=True)
    column, line = (grid[pixel] // tile_size).long().unbind(-1)
    touching = torch.unique((line * tiles_x + column) * len(splats) + row)
    assert torch.isin(touching, listed).all()
    # pixel-sized tiles leave no slack but the small margin for rounding
    assert tile_size > 1 or not min_alpha or len(listed) <= 1.01 * len(touching)


@pytest.mark.parametrize("tile_size", [5, 64])
def test_tiles_of_any_size_draw_the_same(tile_size: int) -> None:
    rasterizer = TorchRasterizer(TorchRasterizer.Config(tile_size=tile_size))
    CHECKS["R50"].run(RasterizerSubject(rasterizer, torch.device("cpu")))


@pytest.mark.parametrize("rasterizer", [OracleRasterizer(), TorchRasterizer()])
def test_chunks_change_nothing(
    rasterizer: OracleRasterizer | TorchRasterizer, monkeypatch: pytest.MonkeyPatch
) -> None:
    gaussians, camera = random_scene(60).to(torch.float64), a_camera().to(torch.float64)
    request = RenderRequest(features=torch.randn(60, 2, dtype=torch.float64))
    whole = rasterizer.render(gaussians, camera, request)
    monkeypatch.setattr(compositing, "CHUNK", 500)
    for name, image in images(rasterizer.render(gaussians, camera, request)).items():
        torch.testing.assert_close(image, images(whole)[name], atol=1e-12, rtol=0)


def test_the_oracle_ignores_cutoffs_by_default() -> None:
    gaussians, camera = random_scene(100, degree=0), a_camera()
    free = RenderRequest(min_alpha=0.0, min_transmittance=0.0)
    default = OracleRasterizer().render(gaussians, camera)
    assert torch.equal(
        default.color,
        OracleRasterizer(OracleRasterizer.Config(cutoffs=True))
        .render(gaussians, camera, free)
        .color,
    )
    cut = CUT.render(gaussians, camera)
    assert default.color.dtype == torch.float64
    assert 1e-4 < float((default.color - cut.color).abs().max()) < 0.1


@pytest.mark.parametrize("backend", [TorchRasterizer, OracleRasterizer, WarpRasterizer])
def test_gaussians_in_the_camera_and_on_its_plane(backend) -> None:  # F20
    camera, scene = a_camera(), random_scene(40)
    z = torch.tensor([0.0, 1e-6, -1e-6, 0.005, -0.5, -4.0])
    means = torch.cat((scene.means, camera.center + z[:, None] * camera.world_to_camera[2, :3]))
    both = Gaussians.from_points(means, scales=0.2, opacity=0.9)
    leaf = both.map(lambda x: x.clone().requires_grad_())
    output = backend().render(leaf, camera)
    output.color.square().sum().backward()
    assert output.color.isfinite().all() and not output.info["radii"][len(scene) :].any()
    assert all(field.grad.isfinite().all() for field in (leaf.means, leaf.log_scales, leaf.quats))
    assert leaf.means.grad[: len(scene)].any() and not leaf.means.grad[len(scene) :].any()


@pytest.mark.parametrize("rasterizer", [TorchRasterizer(), OracleRasterizer(), WarpRasterizer()])
def test_arguments_of_another_type_are_named(rasterizer: Rasterizer) -> None:
    gaussians, camera = random_scene(3), a_camera()
    with pytest.raises(RenderError, match=r"gaussians is of type Camera, expected Gaussians"):
        rasterizer.render(camera, gaussians)  # type: ignore[arg-type]
    with pytest.raises(RenderError, match=r"request is of type int"):
        rasterizer.render(gaussians, camera, 3)  # type: ignore[arg-type]
