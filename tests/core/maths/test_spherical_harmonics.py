"""Spherical harmonics against scipy's, in 3DGS's order and signs."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from hoigs.core.maths.spherical_harmonics import sh_basis, sh_to_colors
from hoigs.core.values.gaussians import SH_C0


def directions(count: int = 50) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return torch.nn.functional.normalize(points, dim=-1)


def complex_harmonic(degree: int, order: int, d: np.ndarray) -> np.ndarray:
    """Y_l^m with the Condon-Shortley phase, by associated Legendre functions."""
    from math import factorial, pi

    from scipy.special import lpmv

    norm = np.sqrt(
        (2 * degree + 1) / (4 * pi) * factorial(degree - order) / factorial(degree + order)
    )
    longitude = np.arctan2(d[:, 1], d[:, 0])
    return norm * lpmv(order, degree, d[:, 2]) * np.exp(1j * order * longitude)


def test_basis_is_scipys() -> None:
    """Band (l, m) is sqrt(2) Im for m < 0 and sqrt(2) Re for m > 0, as in 3DGS."""
    d = directions()
    columns = []
    for degree in range(5):
        for order in range(-degree, degree + 1):
            y = complex_harmonic(degree, abs(order), d.numpy())
            columns.append(y.real if order == 0 else 2**0.5 * (y.imag if order < 0 else y.real))
    torch.testing.assert_close(sh_basis(d, 4), torch.from_numpy(np.stack(columns, -1)))


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_lower_degrees_are_the_first_bands(degree: int) -> None:
    d = directions()
    count = (degree + 1) ** 2
    torch.testing.assert_close(sh_basis(d, degree), sh_basis(d, 3)[:, :count])


def test_signs_of_the_first_band() -> None:
    """The convention that a checkpoint of 3DGS or gsplat is read by."""
    basis = sh_basis(torch.eye(3), 1)
    c = 0.4886025
    wanted = torch.tensor([[0, 0, -c], [-c, 0, 0], [0, c, 0]])
    torch.testing.assert_close(basis[:, 1:], wanted)
    torch.testing.assert_close(basis[:, 0], torch.full((3,), SH_C0))


@pytest.mark.parametrize("degree", [-1, 5])
def test_other_degrees_are_refused(degree: int) -> None:
    with pytest.raises(ValueError, match=f"{degree}.* 0 to 4"):
        sh_basis(directions(), degree)


def test_colour_is_clamped_below_and_its_gradient_stops() -> None:
    sh = torch.zeros(2, 1, 3)
    sh[0, 0, 0] = -10.0
    sh.requires_grad_()
    colors = sh_to_colors(sh, torch.randn(2, 3), torch.zeros(3))
    assert colors[0, 0] == 0.0 and (colors[1] == 0.5).all()
    colors.sum().backward()
    assert sh.grad[0, 0, 0] == 0.0
    assert sh.grad[1, 0, 0].item() == pytest.approx(SH_C0)


def test_gradients_reach_coefficients_means_and_camera() -> None:
    generator = torch.Generator().manual_seed(1)
    sh = torch.randn(4, 16, 3, generator=generator, dtype=torch.float64) * 0.1
    means = directions(4) * 3
    center = torch.tensor([0.1, 0.2, -0.3], dtype=torch.float64)
    inputs = [x.requires_grad_() for x in (sh, means, center)]
    assert torch.autograd.gradcheck(sh_to_colors, inputs)
    _, to_means, to_center = torch.autograd.grad(sh_to_colors(*inputs).sum(), inputs)
    assert to_means.abs().max() > 1e-3
    torch.testing.assert_close(to_center, -to_means.sum(0))


def test_active_degree_uses_fewer_bands() -> None:
    generator = torch.Generator().manual_seed(1)
    sh = torch.randn(4, 16, 3, generator=generator, dtype=torch.float64) * 0.1
    means, center = directions(4), torch.zeros(3, dtype=torch.float64)
    for degree in range(4):
        fewer = sh_to_colors(sh[:, : (degree + 1) ** 2], means, center)
        torch.testing.assert_close(sh_to_colors(sh, means, center, degree), fewer)
    more = sh_to_colors(sh[:, :4], means, center, 3)
    torch.testing.assert_close(more, sh_to_colors(sh, means, center, 1))
