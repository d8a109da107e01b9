"""Clouds and statistics that the tests of density control share."""

from __future__ import annotations

import torch

from hoigs.core.interfaces.density import DensityControl, DensityStatistics, Refinement
from hoigs.core.values.gaussians import Gaussians

EXTENT = 2.0  # so that scales up to 0.02 are cloned


def cloud(scales, opacities=None, seed: int = 0) -> Gaussians:
    scales = torch.as_tensor(scales)
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(len(scales), 3, generator=generator)
    canonical = Gaussians.from_points(points, scales=scales)
    if opacities is not None:
        canonical = canonical.replace(opacity_logits=torch.logit(torch.as_tensor(opacities)))
    return canonical


def varied(count: int, seed: int = 0) -> Gaussians:
    """Anisotropic, turned, of opacities from 0.05 to 0.95, SH degree 1."""
    generator = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn(*shape, generator=generator)  # noqa: E731
    opacities = 0.05 + 0.9 * torch.rand(count, generator=generator)
    return Gaussians(
        draw(count, 3), draw(count, 4), draw(count, 3) * 0.5 - 2, opacities.logit(),
        draw(count, 4, 3),
    )  # fmt: skip


def statistics(gradients, radii=None, *, absolute=None, loss=None) -> DensityStatistics:
    """Over three views, in all of which each Gaussian was drawn."""
    gradients = torch.as_tensor(gradients)
    more = {"absolute_sum": absolute, "loss_sum": loss}
    return DensityStatistics(
        gradients * 3,
        torch.full_like(gradients, 3),
        torch.ones_like(gradients) if radii is None else torch.as_tensor(radii),
        **{name: torch.as_tensor(x) * 3 for name, x in more.items() if x is not None},
    )


def refine(
    control: DensityControl, canonical: Gaussians, stats=None, step=100, total=1000, current=None
) -> Refinement | None:
    stats = statistics(torch.zeros(len(canonical))) if stats is None else stats
    return control.refine(
        canonical, current or canonical, stats, step=step, total_steps=total, extent=EXTENT
    )
