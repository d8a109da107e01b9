"""A human's feature planes, in two readings, and the body points at which phi is read."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Int
from torch import Tensor

from hoigs.core.interfaces.body import PART_NAMES
from hoigs.core.maths.feature_planes import PairedPlanes, ProductPlanes

Fusion = Literal["paired", "product"]

FRACTIONS = (4, 2, 1)  # of the finest resolution: three scales of 32 channels are 96 again


def body_planes(
    fusion: Fusion, channels: int, resolution: int, time_resolution: int
) -> PairedPlanes | ProductPlanes:
    """The planes of a human, 3 * channels wide; see HexPlaneSkinningConfig.fusion."""
    if fusion == "paired":
        return PairedPlanes(channels, resolution, time_resolution)
    sizes = [max(2, resolution // fraction) for fraction in FRACTIONS]
    # a product of three values near 0.45 varies as much as a single value of paired planes
    return ProductPlanes(channels, sizes, time_resolution, spread=(0.1, 0.8))


def field_subset(vertex_parts: Int[Tensor, " V"], count: int) -> Int[Tensor, " S"]:
    """About `count` vertices, equally many of each of the 16 parts, spread evenly by index.

    Raises:
        ValueError: a part has no vertex, and so the human would lack its token.
    """
    chosen = []
    for part, name in enumerate(PART_NAMES):
        rows = (vertex_parts == part).nonzero().squeeze(1)
        if len(rows) == 0:
            raise ValueError(f"the body has no vertex of part {part} ({name})")
        wanted = min(len(rows), -(-count // len(PART_NAMES)))
        picks = torch.linspace(0, len(rows) - 1, wanted, device=rows.device).round().long()
        chosen.append(rows[picks])
    return torch.cat(chosen)
