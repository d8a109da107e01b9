"""Gradients of every backend against the oracle, and of the oracle against differences."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from raster_scenes import (
    CUT,
    RAW,
    Backend,
    a_camera,
    assert_close_gradient,
    clear_of_cutoffs,
    front_camera,
    one_gaussian,
    random_scene,
)
from torch import Tensor

from hoigs.core.camera import Camera
from hoigs.core.gaussians import Gaussians
from hoigs.core.rasterizer import RenderOutput, RenderRequest
from hoigs.rasterizers.oracle import OracleRasterizer
from hoigs.rasterizers.torch_tiles import TorchRasterizer

Render = Callable[[Gaussians, Camera, RenderRequest], RenderOutput]
INPUTS = (*RAW, "features", "screen_offsets", "background", "world_to_camera")


def scene_inputs(seed: int = 0, *, degree: int = 3) -> dict[str, Tensor]:
    """Everything that takes a gradient, by name."""
    gaussians, camera = random_scene(100, degree=degree, seed=seed), a_camera()
    generator = torch.Generator().manual_seed(seed + 100)
    return {
        **{name: getattr(gaussians, name) for name in RAW},
        "features": torch.randn(100, 4, generator=generator),
        "screen_offsets": torch.randn(100, 2, generator=generator) * 0.5,
        "background": torch.rand(camera.height, camera.width, 3, generator=generator),
        "world_to_camera": camera.world_to_camera,
    }


def compose(inputs: dict[str, Tensor]) -> tuple[Gaussians, Camera, RenderRequest]:
    gaussians = Gaussians(*(inputs[name] for name in RAW))
    base = a_camera()
    camera = Camera(base.K.to(gaussians.means), inputs["world_to_camera"], base.width, base.height)
    request = RenderRequest(
        **{k: inputs[k] for k in ("features", "screen_offsets", "background") if k in inputs}
    )
    return gaussians, camera, request


def gradients(
    render: Render, inputs: dict[str, Tensor], clear: Tensor, parts: tuple[str, ...]
) -> dict[str, Tensor | None]:
    """Of a fixed random weighting of the images `parts` at the pixels `clear`."""
    leaves = {name: x.clone().requires_grad_() for name, x in inputs.items()}
    output = render(*compose(leaves))
    generator = torch.Generator().manual_seed(9)
    loss = torch.zeros((), dtype=torch.float64)
    for part in ("color", "alpha", "depth", "features"):
        image = getattr(output, part).double().cpu()
        weights = torch.randn(image.shape, generator=generator, dtype=torch.float64)
        if part in parts:
            loss = loss + (image * weights)[clear].sum()
    loss.backward()
    return {name: x.grad for name, x in leaves.items()}


@pytest.mark.parametrize(
    "parts",
    [("color", "alpha", "depth", "features"), ("color",), ("alpha",), ("depth",), ("features",)],
    ids="+".join,
)
def test_gradients_agree_with_the_oracle(backend: Backend, parts: tuple[str, ...]) -> None:
    inputs = scene_inputs()
    clear = clear_of_cutoffs(*compose(inputs))
    wanted = gradients(CUT.render, inputs, clear, parts)
    actual = gradients(backend.render, inputs, clear, parts)
    checked = 0
    for name in INPUTS:
        reference = wanted[name]
        if reference is None or not reference.any():
            assert actual[name] is None or not actual[name].any(), name
            continue
        assert_close_gradient(name, actual[name], reference)
        checked += 1
    assert checked >= (7 if parts == ("color",) else 6)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_gradients_of_every_harmonic_degree(backend: Backend, degree: int) -> None:
    inputs = scene_inputs(seed=3, degree=degree)
    clear = clear_of_cutoffs(*compose(inputs))
    wanted = gradients(CUT.render, inputs, clear, ("color",))
    actual = gradients(backend.render, inputs, clear, ("color",))
    for name in ("sh", "means", "world_to_camera"):
        assert_close_gradient(name, actual[name], wanted[name])


def test_torch_in_float64_is_the_oracle() -> None:
    inputs = {name: x.double() for name, x in scene_inputs().items()}
    everywhere = torch.ones(30, 44, dtype=torch.bool)
    parts = ("color", "alpha", "depth", "features")
    wanted = gradients(CUT.render, inputs, everywhere, parts)
    for tile_size in (5, 16, 64):
        actual = gradients(TorchRasterizer(tile_size).render, inputs, everywhere, parts)
        for name in INPUTS:
            torch.testing.assert_close(actual[name], wanted[name], atol=1e-9, rtol=1e-9)


def test_background_colour_takes_its_gradient(backend: Backend) -> None:
    gaussians, camera = random_scene(50, degree=0), a_camera()
    color = torch.tensor([0.2, 0.5, 0.7], requires_grad=True)
    output = backend.render(gaussians, camera, RenderRequest(background=color))
    output.color.sum().backward()
    left = (1 - output.alpha).sum().item()
    torch.testing.assert_close(color.grad, torch.full((3,), left), rtol=1e-5, atol=0)


def test_screen_offsets_get_the_screen_space_gradient(backend: Backend) -> None:
    """A zero tensor that requires grad, as density control uses it."""
    gaussians, camera = random_scene(50, degree=0), a_camera()
    offsets = torch.zeros(50, 2, requires_grad=True)
    request = RenderRequest(screen_offsets=offsets)
    backend.render(gaussians, camera, request).color.square().sum().backward()
    shifted = offsets.detach().double()
    seen = int(offsets.grad.norm(dim=-1).argmax())
    losses = []
    for step in (1e-4, -1e-4):
        shifted[seen, 0] = step
        moved = RenderRequest(screen_offsets=shifted.clone())
        losses.append(CUT.render(gaussians, camera, moved).color.square().sum())
    slope = float(losses[0] - losses[1]) / 2e-4
    assert float(offsets.grad[seen, 0]) == pytest.approx(slope, rel=1e-3)


def test_no_gradient_where_alpha_is_clamped(backend: Backend) -> None:
    splat = one_gaussian(scale=3.0).replace(opacity_logits=torch.tensor([8.0]))
    splat = splat.map(lambda x: x.clone().requires_grad_())
    request = RenderRequest(max_alpha=0.3)
    output = backend.render(splat, front_camera(), request)
    assert output.alpha[7, 10].item() == pytest.approx(0.3)
    output.alpha[5:10, 8:13].sum().backward()
    for name in ("means", "log_scales", "opacity_logits"):
        assert not getattr(splat, name).grad.any(), name


def test_no_gradient_to_colours_clamped_at_zero(backend: Backend) -> None:
    splat = one_gaussian(color=(-0.5, 0.5, 0.5)).map(lambda x: x.clone().requires_grad_())
    output = backend.render(splat, front_camera())
    output.color.sum().backward()
    assert not output.color[..., 0].any()
    assert float(splat.sh.grad[0, 0, 0]) == 0.0
    assert float(splat.sh.grad[0, 0, 1]) > 0.0


def test_culled_rows_get_zero_gradients(backend: Backend) -> None:
    behind = one_gaussian((0, 0, -2))
    aside = one_gaussian((50, 0, 2))
    faint = one_gaussian(opacity=0.001)
    gaussians = Gaussians.cat([behind, one_gaussian(), aside, faint])
    gaussians = gaussians.map(lambda x: x.clone().requires_grad_())
    output = backend.render(gaussians, front_camera())
    (output.color.square().sum() + output.depth.sum()).backward()
    assert output.info["radii"].gt(0).tolist() == [False, True, False, False]
    for name in RAW:
        grad = getattr(gaussians, name).grad
        assert not grad[[0, 2, 3]].any(), name
        assert torch.isfinite(grad).all()
    assert gaussians.opacity_logits.grad[1] != 0


def test_the_oracle_passes_gradcheck() -> None:
    generator = torch.Generator().manual_seed(1)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    camera = a_camera(4, 3).to(torch.float64)
    leaves = [
        normal(3, 3) * 0.4,
        normal(3, 4),
        normal(3, 3) * 0.3 - 0.7,
        normal(3) * 0.5,
        normal(3, 4, 3) * 0.2,
        normal(3, 1),
        normal(3, 2) * 0.1,
        torch.rand(3, generator=generator, dtype=torch.float64),
        camera.world_to_camera.clone(),
    ]

    def render(*x: Tensor) -> tuple[Tensor, ...]:
        request = RenderRequest(features=x[5], screen_offsets=x[6], background=x[7])
        view = Camera(camera.K, x[8], 4, 3)
        output = OracleRasterizer().render(Gaussians(*x[:5]), view, request)
        return output.color, output.alpha, output.depth, output.features

    torch.autograd.gradcheck(render, [x.requires_grad_() for x in leaves], eps=1e-6, atol=1e-6)
