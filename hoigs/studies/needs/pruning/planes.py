"""Time planes that are one everywhere, and so change nothing (K-Planes, 2023; 4DGS, 2024)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import nn

from hoigs.core.interfaces.deformation import DeformationModel

ONE = 1e-4  # planes nearer to one than this change no image by a grey level


def time_planes(deformation: DeformationModel) -> list[nn.Parameter]:
    """The space-time planes of a deformation that multiplies with them; none of another."""
    planes = getattr(deformation, "planes", None)
    if not isinstance(planes, nn.Module):
        return []
    return [p for n, p in planes.named_parameters() if n.partition(".")[0] == "time"]


def from_one(planes: Sequence[nn.Parameter]) -> float:
    """The largest distance of any of their values from one."""
    return max(float((p.detach() - 1).abs().max()) for p in planes)


@contextmanager
def as_one(planes: Sequence[nn.Parameter]) -> Iterator[None]:
    """Set planes to one inside the block, and restore them after it."""
    kept = [p.detach().clone() for p in planes]
    try:
        with torch.no_grad():
            for p in planes:
                p.fill_(1.0)
        yield
    finally:
        with torch.no_grad():
            for p, value in zip(planes, kept, strict=True):
                p.copy_(value)
