"""A small cloud, and entities of it whose parameters are off their start."""

from __future__ import annotations

import torch

from hoigs.core.model.entity import Entity
from hoigs.core.values.gaussians import Gaussians

COUNT = 14
ALL_HEADS = ("means", "scales", "rotations", "opacity", "sh")


def cloud(count: int = COUNT, dtype: torch.dtype = torch.float32) -> Gaussians:
    generator = torch.Generator().manual_seed(3)
    points = torch.randn(count, 3, generator=generator, dtype=dtype)
    colors = torch.rand(count, 3, generator=generator, dtype=dtype)
    canonical = Gaussians.from_points(points, colors, scales=0.1, sh_degree=1)
    quats = torch.randn(count, 4, generator=generator, dtype=dtype)
    return canonical.replace(quats=quats)


def perturbed(model, canonical: Gaussians, size: float = 0.2) -> Entity:
    """An entity whose every parameter is off its start, heads that start at zero too."""
    torch.manual_seed(1)
    entity = Entity(canonical, model).to(canonical.means)
    with torch.no_grad():
        for parameter in entity.deformation.parameters():
            parameter += size * torch.randn_like(parameter)
    return entity
