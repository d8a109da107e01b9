"""A readable tiled rasterizer in plain torch: any device, float32 or float64, by autograd."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor

from hoigs.core.camera import Camera
from hoigs.core.config import ComponentConfig
from hoigs.core.gaussians import Gaussians
from hoigs.core.rasterizer import Capabilities, Rasterizer, RenderOutput, RenderRequest
from hoigs.rasterizers.compositing import Splats, blend, prepare, squared_distances, to_output


class TorchConfig(ComponentConfig):
    tile_size: int = Field(16, ge=1, description="side of a tile, pixels")


class TorchRasterizer(Rasterizer):
    """Splats are listed by the tiles that they touch, then each tile is blended on its own.

    Fit for small trainings and for reading; `rasterizer:warp` draws the same picture faster.

    Args:
        tile_size: side of a tile in pixels; changes speed only, never the picture.
    """

    capabilities = Capabilities(
        devices=frozenset({"cpu", "cuda"}),
        dtypes=frozenset({"float32", "float64"}),
        camera_gradients=True,
        deterministic=True,
        absolute_gradients=True,
    )

    def __init__(self, tile_size: int = 16) -> None:
        if tile_size < 1:
            raise ValueError(f"TorchRasterizer: tile_size {tile_size}, expected at least 1")
        self.tile_size = tile_size

    def render(
        self, gaussians: Gaussians, camera: Camera, request: RenderRequest | None = None
    ) -> RenderOutput:
        """Draw in the dtype of the Gaussians; see `Rasterizer.render`."""
        request = request or RenderRequest()
        self.check_inputs(gaussians, camera, request)
        camera = camera.to(gaussians.means.dtype)
        splats, info = prepare(gaussians, camera, request)
        tiles, rows = list_by_tile(splats, camera, self.tile_size, request.min_alpha)

        numbers = torch.arange(camera.height * camera.width, device=tiles.device)
        numbers = numbers.reshape(camera.height, camera.width)
        grid = camera.pixel_grid()
        across = -(-camera.width // self.tile_size)
        # the empty first parts tie even a picture without splats to the graph, with zero gradients
        where = [numbers.flatten()[:0]]
        blended = [blend(grid.flatten(0, 1)[:0], splats[rows[:0]], request)]
        touched, counts = tiles.unique_consecutive(return_counts=True)
        for tile, members in zip(touched.tolist(), splats[rows].split(counts.tolist())):
            y, x = (self.tile_size * i for i in divmod(tile, across))
            window = (slice(y, y + self.tile_size), slice(x, x + self.tile_size))
            where.append(numbers[window].flatten())
            blended.append(blend(grid[window].flatten(0, 1), members, request))
        values = torch.cat(blended)
        image = values.new_zeros(numbers.numel(), values.shape[1])
        return to_output(image.index_copy(0, torch.cat(where), values), camera, request, info)


@torch.no_grad()
def list_by_tile(
    splats: Splats, camera: Camera, tile_size: int, min_alpha: float
) -> tuple[Int[Tensor, " L"], Int[Tensor, " L"]]:
    """All pairs (tile, splat) that may touch: tile numbers ascending, splats in order within each.

    A splat touches a tile when the ellipse opacity exp(-q / 2) >= min_alpha reaches one of its
    pixel centres' bounding rectangle: q is smallest at the centre, and outside of it on the edges
    that face the centre, where it is a parabola (as in Speedy-Splat, Hanson et al. 2025).
    """
    size = splats.means2d.new_tensor([camera.width, camera.height])
    counts = torch.ceil(size / tile_size).long()
    # half a pixel more than the box: rounding can't lose a pair, and the next test is tight
    first = ((splats.means2d - splats.extents - 0.5) / tile_size).floor()
    last = ((splats.means2d + splats.extents + 0.5) / tile_size).floor()
    first, last = (
        x.clamp(min=torch.zeros_like(size), max=counts - 1).long() for x in (first, last)
    )
    span = last - first + 1
    pairs = span.prod(-1)
    row = torch.repeat_interleave(torch.arange(len(splats), device=pairs.device), pairs)
    inner = torch.arange(len(row), device=row.device) - (pairs.cumsum(0) - pairs)[row]
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
