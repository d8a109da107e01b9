"""A readable tiled rasterizer in plain torch: any device, float32 or float64, by autograd."""

from __future__ import annotations

from typing import ClassVar

import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor

from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.rasterizer import (
    OPTICS,
    Capabilities,
    Rasterizer,
    RenderOutput,
    RenderRequest,
)
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.rasterizers.compositing import Splats, blend, prepare, squared_distances, to_output


class TorchConfig(ComponentConfig):
    """Settings of TorchRasterizer; the tile size changes speed only, never the picture."""

    tile_size: int = Field(default=16, ge=1, description="side of a tile, pixels")


class TorchRasterizer(Rasterizer):
    """Finds the tiles that each splat touches, then blends each tile on its own.

    For small trainings and for reading; `rasterizer:warp` draws the same picture faster.
    """

    Config: ClassVar = TorchConfig
    capabilities = Capabilities(
        devices=frozenset({"cpu", "cuda"}),
        dtypes=frozenset({"float32", "float64"}),
        camera_gradients=True,
        deterministic=True,
        absolute_gradients=True,
        optics=OPTICS,
    )

    def __init__(self, config: TorchConfig | None = None) -> None:
        self.config = config or TorchConfig()

    def render(
        self, gaussians: Gaussians, camera: Camera, request: RenderRequest | None = None
    ) -> RenderOutput:
        """Draw in the dtype of the Gaussians; see `Rasterizer.render`."""
        request = request or RenderRequest()
        self.check_inputs(gaussians, camera, request)
        camera = camera.to(gaussians.means.dtype)
        splats, info = prepare(gaussians, camera, request)
        size = self.config.tile_size
        tiles, rows = tile_intersections(splats, camera, size, request.min_alpha)

        numbers = torch.arange(camera.height * camera.width, device=tiles.device)
        numbers = numbers.reshape(camera.height, camera.width)
        grid = camera.pixel_grid()
        tiles_x = -(-camera.width // size)
        # the empty first parts tie even a picture without splats to the graph, with zero gradients
        where = [numbers.flatten()[:0]]
        blended = [blend(grid.flatten(0, 1)[:0], splats[rows[:0]], request)]
        touched, counts = tiles.unique_consecutive(return_counts=True)
        for tile, members in zip(touched.tolist(), splats[rows].split(counts.tolist())):
            y, x = (size * i for i in divmod(tile, tiles_x))
            window = (slice(y, y + size), slice(x, x + size))
            where.append(numbers[window].flatten())
            blended.append(blend(grid[window].flatten(0, 1), members, request))
        values = torch.cat(blended)
        image = values.new_zeros(numbers.numel(), values.shape[1])
        return to_output(image.index_copy(0, torch.cat(where), values), camera, request, info)


@torch.no_grad()
def tile_intersections(
    splats: Splats, camera: Camera, tile_size: int, min_alpha: float
) -> tuple[Int[Tensor, " L"], Int[Tensor, " L"]]:
    """Tile and splat of each intersection: tiles ascending, splats in their order within each.

    A splat touches a tile when the ellipse opacity exp(-q / 2) >= min_alpha reaches the bounding
    rectangle of its pixel centres. q is smallest at the splat's centre; on the edges of a rectangle
    that does not hold it, q is a parabola (Speedy-Splat, Hanson et al. 2025, arXiv:2412.00578).
    """
    size = splats.means2d.new_tensor([camera.width, camera.height])
    counts = torch.ceil(size / tile_size).long()
    # half a pixel more than the box, so that rounding loses nothing; the next test is exact
    first = ((splats.means2d - splats.extents - 0.5) / tile_size).floor()
    last = ((splats.means2d + splats.extents + 0.5) / tile_size).floor()
    first, last = (
        x.clamp(min=torch.zeros_like(size), max=counts - 1).long() for x in (first, last)
    )
    span = last - first + 1
    touched = span.prod(-1)
    row = torch.repeat_interleave(torch.arange(len(splats), device=touched.device), touched)
    inner = torch.arange(len(row), device=row.device) - (touched.cumsum(0) - touched)[row]
    column, line = first[row, 0] + inner % span[row, 0], first[row, 1] + inner // span[row, 0]
    tile = line * counts[0] + column
    if min_alpha > 0:
        low = torch.stack((column, line), -1) * tile_size + 0.5
        high = torch.minimum(low + (tile_size - 1), size - 0.5)
        touching = _touches(splats, row, low, high, min_alpha)
        tile, row = tile[touching], row[touching]
    tile, order = tile.sort(stable=True)
    return tile, row[order]


def _touches(
    splats: Splats,
    row: Int[Tensor, " L"],
    low: Float[Tensor, "L 2"],
    high: Float[Tensor, "L 2"],
    min_alpha: float,
) -> Tensor:
    """Whether ellipses reach into rectangles from `low` to `high`, pixels: boolean [L]."""
    centre, covs, conics = splats.means2d[row], splats.covs[row], splats.conics[row]
    low, high = low - centre, high - centre
    nearest = torch.zeros_like(low).clamp(low, high)  # 0 within the rectangle's range
    xx, xy, yy = covs.unbind(-1)
    on_side = torch.minimum(torch.maximum(xy / xx * nearest[:, 0], low[:, 1]), high[:, 1])
    on_top = torch.minimum(torch.maximum(xy / yy * nearest[:, 1], low[:, 0]), high[:, 0])
    smallest = torch.minimum(
        squared_distances(nearest[:, 0], on_side, covs, conics),
        squared_distances(on_top, nearest[:, 1], covs, conics),
    )
    reach = 2.0 * (splats.opacities / min_alpha).log()[row]
    return smallest <= reach * 1.0001 + 1e-3  # a little more: alpha >= min_alpha decides
