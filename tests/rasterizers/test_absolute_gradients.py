"""RenderRequest.absolute_gradients: sums over pixels that do not cancel."""

from __future__ import annotations

import pytest
import torch
from backends import cases
from raster_scenes import CUT, Backend, a_camera, front_camera, one_gaussian, random_scene
from torch import Tensor

from hoigs.core.errors import RenderError
from hoigs.core.interfaces.rasterizer import RenderOutput, RenderRequest

CAMERA = a_camera(width=20, height=14)
able = pytest.mark.parametrize(
    "backend", list(cases(lambda r: r.capabilities.absolute_gradients)), indirect=True
)


def a_loss(output: RenderOutput) -> Tensor:
    """Loss of each pixel, [H, W], of all composited channels with random signs."""
    generator = torch.Generator().manual_seed(4)
    shape = (*output.alpha.shape, 7)
    weights = torch.randn(shape, generator=generator).to(output.color)
    features = output.features if output.features is not None else output.color[..., :2]
    parts = (output.color, output.alpha[..., None], output.depth[..., None], features)
    return (weights * torch.cat(parts, -1)).sum(-1)


def test_the_oracle_sums_each_pixels_own() -> None:
    """By the definition, from the screen gradient of each pixel's loss; R51 compares the others."""
    camera = a_camera(width=10, height=7)
    scene = random_scene(40, degree=1)
    features = torch.randn(40, 2, generator=torch.Generator().manual_seed(1))
    absolutes = torch.zeros(40, 2, dtype=torch.float64, requires_grad=True)
    request = RenderRequest(features=features, absolute_gradients=absolutes)
    a_loss(CUT.render(scene, camera, request)).sum().backward()
    offsets = torch.zeros(40, 2, dtype=torch.float64, requires_grad=True)
    request = RenderRequest(features=features, screen_offsets=offsets)
    losses = a_loss(CUT.render(scene, camera, request)).flatten()
    rows = [torch.autograd.grad(loss, offsets, retain_graph=True)[0] for loss in losses]
    expected, signed = torch.stack(rows).abs().sum(0), torch.stack(rows).sum(0)
    torch.testing.assert_close(absolutes.grad, expected, rtol=1e-9, atol=1e-9)
    assert (expected > signed.abs() * 1.5).any(-1).float().mean() > 0.5  # much does cancel


@able
def test_opposite_gradients_cancel_only_in_the_signed_gradient(backend: Backend) -> None:
    offsets = torch.zeros(1, 2, device=backend.device, requires_grad=True)
    absolutes = torch.zeros(1, 2, device=backend.device, requires_grad=True)
    request = RenderRequest(screen_offsets=offsets, absolute_gradients=absolutes)
    output = backend.render(one_gaussian(), front_camera(), request)
    output.color.sum().backward()  # symmetric: the two sides have opposite gradients
    assert offsets.grad is not None
    assert absolutes.grad is not None
    assert float(absolutes.grad.min()) > 1.0
    assert float(offsets.grad.abs().max()) < 1e-4


@able
def test_they_leave_picture_and_other_gradients_alone(backend: Backend) -> None:
    found = []
    for requested in (False, True):
        scene = random_scene(40, degree=1).map(lambda x: x.clone().requires_grad_())
        absolutes = torch.full((40, 2), 7.0, device=backend.device, requires_grad=True)
        request = RenderRequest(absolute_gradients=absolutes if requested else None)
        output = backend.render(scene, CAMERA, request)
        a_loss(output).sum().backward()
        found.append((output.color.detach(), scene.means.grad, scene.opacity_logits.grad))
    for plain, other in zip(*found, strict=True):
        assert torch.equal(plain, other)


@able
def test_culled_rows_receive_nothing(backend: Backend) -> None:
    scene = random_scene(12, degree=0)
    subset = torch.arange(12) % 3 != 0
    absolutes = torch.zeros(12, 2, device=backend.device, requires_grad=True)
    request = RenderRequest(absolute_gradients=absolutes, subset=subset)
    a_loss(backend.render(scene, CAMERA, request)).sum().backward()
    assert absolutes.grad is not None
    found = absolutes.grad.cpu()
    assert (found[~subset] == 0).all()
    assert (found[subset].sum(-1) > 0).any()


def test_a_backend_that_cannot_says_so(backend: Backend, monkeypatch: pytest.MonkeyPatch) -> None:
    capabilities = backend.rasterizer.capabilities
    cannot = type(capabilities)(**{**vars(capabilities), "absolute_gradients": False})
    monkeypatch.setattr(type(backend.rasterizer), "capabilities", cannot)
    request = RenderRequest(absolute_gradients=torch.zeros(12, 2))
    with pytest.raises(RenderError, match="cannot compute absolute screen gradients"):
        backend.render(random_scene(12), CAMERA, request)


@able
def test_their_shape_is_checked(backend: Backend) -> None:
    with pytest.raises(RenderError, match=r"absolute_gradients has shape \[11, 2\]"):
        backend.render(
            random_scene(12), CAMERA, RenderRequest(absolute_gradients=torch.zeros(11, 2))
        )
