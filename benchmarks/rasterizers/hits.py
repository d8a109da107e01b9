"""Which splats are drawn at which pixels: a count, and the list for gsplat's torch reference."""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.rasterizers.peers import NotMeasuredError
from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.rasterizers.compositing import project_gaussians

BAND = 16  # pixels: side of the squares that are looked at one by one


def _square(shown: tuple[Tensor, ...], left: int, top: int, width: int, height: int) -> Tensor:
    """Drawn or not [M, height * width], for M splats nearest first."""
    means2d, opacities, conics = shown
    request = RenderRequest()
    x = torch.arange(left, left + width) + 0.5 - means2d[:, 0, None]
    y = torch.arange(top, top + height) + 0.5 - means2d[:, 1, None]
    a, b, c = (conics[:, i, None, None] for i in range(3))
    power = 0.5 * a * x[:, None] ** 2 + 0.5 * c * y[..., None] ** 2 + b * x[:, None] * y[..., None]
    alphas = (opacities[:, None, None] * torch.exp(-power)).clamp_max(request.max_alpha).flatten(1)
    alphas = torch.where(alphas >= request.min_alpha, alphas, 0.0)
    left_over = torch.cumprod(1 - alphas, 0)
    return (alphas > 0) & (left_over > request.min_transmittance)


def squares(gaussians: Gaussians, camera: Camera):  # type: ignore[no-untyped-def]
    """For each square of pixels: its left, top, width, the rows of its splats, drawn or not."""
    with torch.no_grad():
        shown = project_gaussians(gaussians, camera, RenderRequest())
        order = shown.depths.argsort(stable=True)
        means2d, extents = shown.means2d[order], shown.extents[order] + 1
        opacities, conics = shown.opacities[order], shown.conics[order]
        low, high = means2d - extents, means2d + extents
        for top in range(0, camera.height, BAND):
            height = min(BAND, camera.height - top)
            row = (high[:, 1] >= top) & (low[:, 1] <= top + height)
            row_index = row.nonzero().squeeze(1)
            for left in range(0, camera.width, BAND):
                width = min(BAND, camera.width - left)
                inside = (high[row_index, 0] >= left) & (low[row_index, 0] <= left + width)
                near = row_index[inside]
                drawn = _square(
                    (means2d[near], opacities[near], conics[near]), left, top, width, height
                )
                yield left, top, width, shown.index[order[near]], drawn


def count_hits(gaussians: Gaussians, camera: Camera) -> int:
    """How many times a splat is drawn at a pixel."""
    return sum(int(drawn.sum()) for *_, drawn in squares(gaussians, camera))


def hits(gaussians: Gaussians, camera: Camera, most: int) -> tuple[Tensor, Tensor]:
    """Rows of Gaussians and numbers of pixels [M], by pixel and then nearest first.

    Raises:
        NotMeasuredError: there are more than `most`.
    """
    rows, pixels, total = [], [], 0
    for left, top, width, index, drawn in squares(gaussians, camera):
        pixel, splat = drawn.T.nonzero(as_tuple=True)
        rows.append(index[splat])
        pixels.append((top + pixel // width) * camera.width + left + pixel % width)
        total += len(splat)
        if total > most:
            raise NotMeasuredError(f"more than {most} hits: its tensors would take many gigabytes")
    row, pixel = torch.cat(rows), torch.cat(pixels)
    order = pixel.argsort(stable=True)
    return row[order], pixel[order]
