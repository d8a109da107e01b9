"""What the tile kernels are given, on every device."""

from __future__ import annotations

import math
from typing import Any

from torch import Tensor

from hoigs.rasterizers.warp.common.frame import Images, Inputs, Settings, TileIntersections
from hoigs.rasterizers.warp.common.records import SMALLEST_ALPHA


def tile_arguments(
    inputs: Inputs,
    settings: Settings,
    records: Tensor,
    intersections: TileIntersections,
    images: Images,
) -> list[Any]:
    """Arguments that the forward and backward tile kernels have in common."""
    return [
        *(intersections.tiles, intersections.tiles_x, settings.width, settings.height),
        settings.max_alpha,
        math.log2(max(settings.min_alpha, SMALLEST_ALPHA)),
        settings.min_transmittance if settings.min_transmittance > 0 else -1.0,
        *(records, intersections.indices, intersections.offsets),
        *(inputs.features, inputs.channels),
        *(inputs.background, 3 if inputs.background.dim() == 3 else 0),
        *(images.color, images.alpha, images.depth, images.features),
    ]


def upstream_arguments(upstream: Images, partials: Tensor) -> list[Any]:
    """What the backward tile kernels take besides: gradients of the images, and the partials."""
    return [upstream.color, upstream.alpha, upstream.depth, upstream.features, partials]
