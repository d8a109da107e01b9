"""PSNR and SSIM against their definitions, kornia, and finite differences."""

from __future__ import annotations

import math

import pytest
import torch

from hoigs.metrics.psnr import psnr, region_psnr
from hoigs.metrics.ssim import blur, ssim, ssim_map


def pair(*shape: int, dtype: torch.dtype = torch.float32) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(7)
    x = torch.rand(*shape, generator=generator, dtype=dtype)
    noise = torch.randn(*shape, generator=generator, dtype=dtype)
    return x, (x + 0.1 * noise).clamp(0, 1)


def naive_ssim(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """The definition: at each pixel a weighted mean, variance and covariance over 11x11."""
    weights = [math.exp(-((i - 5) ** 2) / (2 * 1.5**2)) for i in range(11)]
    total = sum(weights)
    height, width, channels = x.shape
    out = torch.zeros_like(x)
    for row in range(height):
        for column in range(width):
            for channel in range(channels):
                sums = [0.0] * 5
                for dy in range(11):
                    for dx in range(11):
                        r, c = row + dy - 5, column + dx - 5
                        if not (0 <= r < height and 0 <= c < width):
                            continue  # zero padding
                        w = weights[dy] * weights[dx] / total**2
                        a, b = float(x[r, c, channel]), float(y[r, c, channel])
                        for i, v in enumerate((a, b, a * a, b * b, a * b)):
                            sums[i] += w * v
                mx, my, xx, yy, xy = sums
                numerator = (2 * mx * my + 1e-4) * (2 * (xy - mx * my) + 9e-4)
                denominator = (mx**2 + my**2 + 1e-4) * (xx - mx**2 + yy - my**2 + 9e-4)
                out[row, column, channel] = numerator / denominator
    return out


def test_ssim_is_its_definition() -> None:
    x, y = pair(9, 13, 2, dtype=torch.float64)
    torch.testing.assert_close(ssim_map(x, y), naive_ssim(x, y), rtol=1e-9, atol=1e-12)


def test_ssim_agrees_with_kornia_away_from_the_border() -> None:
    from kornia.metrics import ssim as kornia_ssim  # pads by reflection, so borders differ

    x, y = pair(40, 50, 3, dtype=torch.float64)
    theirs = kornia_ssim(x.permute(2, 0, 1)[None], y.permute(2, 0, 1)[None], 11, eps=0.0)
    inner = (slice(5, -5), slice(5, -5))
    ours = ssim_map(x, y)[inner]
    torch.testing.assert_close(ours, theirs[0].permute(1, 2, 0)[inner], rtol=1e-6, atol=1e-7)


def test_ssim_gradients_by_finite_differences() -> None:
    x, y = pair(5, 6, 1, dtype=torch.float64)
    x.requires_grad_(True)
    y.requires_grad_(True)
    assert torch.autograd.gradcheck(ssim, (x, y))


def test_blur_twice_differentiable() -> None:
    x, _ = pair(1, 4, 5, dtype=torch.float64)
    assert torch.autograd.gradgradcheck(lambda p: blur(p).square(), (x.requires_grad_(True),))


def test_ssim_of_equal_images_is_one_and_falls_with_noise() -> None:
    x, y = pair(32, 32, 3)
    assert float(ssim(x, x)) == pytest.approx(1.0, abs=1e-5)
    assert float(ssim(x, y)) < 0.98
    assert float(ssim(x, 0.5 * (x + y))) > float(ssim(x, y))


def test_ssim_as_a_loss_repairs_an_image() -> None:
    target, start = pair(24, 24, 3)
    image = start.clone().requires_grad_(True)
    optimizer = torch.optim.Adam([image], lr=0.01)
    before = float(ssim(start, target))
    for _ in range(40):
        optimizer.zero_grad()
        (1 - ssim(image, target)).backward()
        optimizer.step()
    assert float(ssim(image.detach(), target)) > before + 0.5 * (1 - before)


def test_batches_are_means_of_images() -> None:
    x, y = pair(3, 16, 16, 3)
    each = torch.stack([psnr(a, b) for a, b in zip(x, y, strict=True)])
    torch.testing.assert_close(psnr(x, y), each.mean())
    each = torch.stack([ssim(a, b) for a, b in zip(x, y, strict=True)])
    torch.testing.assert_close(ssim(x, y), each.mean())


def test_psnr_values() -> None:
    x = torch.zeros(4, 5, 3)
    assert float(psnr(x + 0.1, x)) == pytest.approx(20.0, abs=1e-4)
    assert float(psnr(x, x)) == pytest.approx(100.0)


def test_regions_ignore_what_is_outside_and_divide_by_their_area() -> None:
    x, _ = pair(32, 32, 3)
    region = torch.zeros(32, 32, dtype=torch.bool)
    region[4:12, 4:12] = True
    y = x.clone()
    y[region] += 0.01
    y[~region] = 1 - y[~region]
    assert float(region_psnr(x, y, region)) == pytest.approx(40.0, abs=1e-3)
    whole = torch.ones_like(region)
    torch.testing.assert_close(region_psnr(x, y, whole), psnr(x, y))


def test_mistakes_are_named() -> None:
    x, y = pair(8, 8, 3)
    with pytest.raises(ValueError, match="no pixels"):
        region_psnr(x, y, torch.zeros(8, 8, dtype=torch.bool))
