"""Score distillation: its gradient by formula, its optimum by a denoiser that knows the answer."""

from __future__ import annotations

import math

import pytest
import torch

from hoigs.core.errors import NotFiniteError
from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.core.values.gaussians import Gaussians
from hoigs.plugins.initializers.sds_distillation import (
    Denoiser,
    DistillationConfig,
    Reference,
    annealed_step,
    distil,
    distillation_loss,
    orbit_camera,
    reference_view,
)
from hoigs.rasterizers.warp import WarpRasterizer


class Knows(Denoiser):
    """A perfect denoiser of a world that holds a single image, seen from everywhere alike.

    x_t = sqrt(a) x* + sqrt(1 - a) eps for the image x*, so eps = (x_t - sqrt(a) x*) / sqrt(1 - a).
    """

    def __init__(self, image: torch.Tensor) -> None:
        self.answer, self.size = 2 * image - 1, image.shape[-1]
        self.alphas = torch.linspace(0.999, 0.01, 100)
        self.seen: list[tuple[int, torch.Tensor]] = []

    def encode(self, images):
        return 2 * images - 1

    def predict(self, noisy, step, views):
        self.seen.append((step, views))
        a = self.alphas[step]
        return (noisy - a.sqrt() * self.answer) / (1 - a).sqrt()


def disk(size: int, color: tuple[float, float, float], radius: float) -> torch.Tensor:
    """A disk of a colour on white, soft at its edge: a ball from any side."""
    at = torch.arange(size) + 0.5 - size / 2
    inside = torch.sigmoid((radius * size - (at[:, None] ** 2 + at**2).sqrt()) * 1.5)
    return 1 - inside * (1 - torch.tensor(color)[:, None, None])


def test_the_gradient_is_dreamfusions():
    """d/dx = w(t) (eps_hat - eps) / B; of a perfect denoiser, in closed form."""
    denoiser = Knows(disk(16, (1, 0, 0), 0.3))
    images = torch.rand(2, 3, 16, 16).requires_grad_()
    for step in (5, 50, 95):
        loss = distillation_loss(
            denoiser, images, torch.zeros(2, 3), step, torch.Generator().manual_seed(step)
        )
        (gradient,) = torch.autograd.grad(loss, images)
        a = denoiser.alphas[step]
        away = (2 * images - 1) - denoiser.answer
        expected = (1 - a) * (a / (1 - a)).sqrt() * away * 2 / 2  # dx/dimage = 2, B = 2
        torch.testing.assert_close(gradient, expected.detach(), atol=1e-4, rtol=1e-3)


def test_noise_anneals_from_noisy_to_clean():
    steps = [annealed_step(i / 100, 1000) for i in range(1, 101)]
    assert steps[0] == 980 and steps[-1] == 20
    assert steps == sorted(steps, reverse=True) and steps[49] == 500


def test_nan_of_the_model_is_told():
    denoiser = Knows(disk(8, (1, 0, 0), 0.3))
    denoiser.answer = denoiser.answer * torch.nan
    with pytest.raises(NotFiniteError, match="at noise step 7; with half: true"):
        distillation_loss(denoiser, torch.rand(1, 3, 8, 8), torch.zeros(1, 3), 7, torch.Generator())


def test_cameras_on_the_orbit():
    settings = DistillationConfig()
    front = orbit_camera(torch.zeros(3), settings, 64)
    torch.testing.assert_close(front.world_to_camera[:3, :3], torch.eye(3), atol=1e-6, rtol=0)
    assert front.world_to_camera[:3, 3].tolist() == pytest.approx([0, 0, 2])
    right = orbit_camera(torch.tensor([0, math.pi / 2, 0]), settings, 64)
    assert right.center.tolist() == pytest.approx([2, 0, 0], abs=1e-5)
    below = orbit_camera(torch.tensor([0.5, 0, 0.5]), settings, 64)
    assert below.center[1] > 1 and below.center.norm() == pytest.approx(2.5)  # y points down
    above = orbit_camera(torch.zeros(3), DistillationConfig(elevation_degrees=30), 64)
    assert above.center.tolist() == pytest.approx([0, -1, -(3**0.5)], abs=1e-5)
    for camera in (front, right, below, above):
        assert camera.project(torch.zeros(3))[0].tolist() == pytest.approx([32, 32], abs=1e-3)
        assert camera.world_to_camera[1, 1] > 0  # upright


SMALL = {"count": 250, "steps": 150, "image_weight": 0.0, "mask_weight": 0.0}


def error_all_round(gaussians: Gaussians, answer: torch.Tensor, settings) -> float:
    """Mean squared error of views that training has never seen."""
    total = []
    for azimuth in (0.3, 1.7, 2.9, -1.1):
        camera = orbit_camera(torch.tensor([0.1, azimuth, 0]), settings, answer.shape[-1])
        request = RenderRequest(background=torch.ones(3))
        drawn = WarpRasterizer().render(gaussians, camera, request).color.permute(2, 0, 1)
        total.append(float((drawn - answer).square().mean()))
    return sum(total) / len(total)


def test_distillation_finds_the_known_optimum():
    answer = disk(24, (0.9, 0.2, 0.1), 0.25)
    denoiser = Knows(answer)
    settings = DistillationConfig(**SMALL)
    made = distil(denoiser, WarpRasterizer(), None, settings, seed=3)
    still = distil(
        denoiser, WarpRasterizer(), None, settings.model_copy(update={"steps": 1}), seed=3
    )
    before, after = (error_all_round(g, answer, settings) for g in (still, made))
    assert after < 0.1 * before
    red, _, blue = made.colors.mean(0).tolist()
    assert red > 0.6 and blue < 0.45
    # views went all round and never over a pole; noise fell
    views = torch.cat([v for _, v in denoiser.seen[:150]])
    assert views[:, 1].amax() > 2.5 and views[:, 1].amin() < -2.5
    assert views[:, 0].abs().amax() <= math.radians(30)
    assert denoiser.seen[0][0] == 98 and denoiser.seen[149][0] == 2


def test_the_same_seed_gives_the_same_gaussians():
    denoiser = Knows(disk(16, (0, 0, 1), 0.3))
    settings = DistillationConfig(count=40, steps=3, min_opacity=0.01)
    first, again, other = (
        distil(denoiser, WarpRasterizer(), None, settings, seed=s).means for s in (1, 1, 2)
    )
    assert torch.equal(first, again) and not torch.equal(first, other)


def test_the_known_view_is_learned():
    """Without a diffusion model the reference alone shapes what is seen from the front."""
    answer = disk(24, (0.1, 0.3, 0.9), 0.25)
    mask = (answer.amin(0) < 0.6).float()
    reference = Reference(answer.permute(1, 2, 0), mask)
    settings = DistillationConfig(count=250, steps=60, sds_weight=0.0)
    made = distil(Knows(answer), WarpRasterizer(), reference, settings)
    camera = orbit_camera(torch.zeros(3), settings, 24)
    output = WarpRasterizer().render(made, camera, RenderRequest(background=torch.ones(3)))
    assert (output.color - reference.image).square().mean() < 0.01
    assert (output.alpha - mask).abs().mean() < 0.1


def test_the_reference_is_the_object_cut_out(clip):
    at = clip.split["train"][0]
    view = reference_view(clip, "object", at, 64)
    frame = clip[at]
    assert (view.image[view.mask == 0] == 1).all()
    rows, columns = (view.mask > 0.5).nonzero(as_tuple=True)
    reach = max(int(rows.max() - rows.min()), int(columns.max() - columns.min())) + 1
    assert reach == pytest.approx(0.8 * 64, abs=2)
    middle = (rows.float().mean() + columns.float().mean()) / 2
    assert abs(float(middle) - 31.5) < 4
    inside = view.mask > 0.99
    truth = frame.rgb[frame.masks["object"]].mean(0)
    torch.testing.assert_close(view.image[inside].mean(0), truth, atol=0.1, rtol=0)
