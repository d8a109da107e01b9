"""The five operations of gsplat 1.5.3 that the adapter calls, in plain torch on the CPU.

Written from their documentation and constants, so that the adapter can be held to the conformance
checks where there is no GPU. As gsplat does, it works in float32 with conics from a difference of
products, leaves rows that it culls unset (NaN here), and refuses what gsplat refuses.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hoigs.core.maths.rotations import quats_to_matrices
from hoigs.core.maths.spherical_harmonics import sh_basis

MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE = 0.999, 1 / 255, 1e-4


def fully_fused_projection(
    means: Tensor,
    covars: None,
    quats: Tensor,
    scales: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    eps2d: float,
    near_plane: float,
    far_plane: float,
    calc_compensations: bool,
    opacities: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor | None]:
    """radii [C, N, 2] int32, means2d [C, N, 2], depths [C, N], conics [C, N, 3], and the shares of
    opacities that are kept [C, N], or None."""
    count = means.shape[0]
    if count == 0:
        raise ZeroDivisionError("gsplat divides by the number of rows")
    assert covars is None and viewmats.shape == (1, 4, 4) and Ks.shape == (1, 3, 3)
    assert quats.shape == (count, 4) and scales.shape == (count, 3) and opacities.shape == (count,)
    rotation, K = viewmats[0, :3, :3], Ks[0].detach()
    x, y, z = (means @ rotation.mT + viewmats[0, :3, 3]).unbind(-1)
    bounds = []
    for focal, centre, size in ((K[0, 0], K[0, 2], width), (K[1, 1], K[1, 2], height)):
        margin = 0.3 * 0.5 * size / focal
        bounds.append((-(centre / focal + margin), (size - centre) / focal + margin))
    slopes = [torch.clamp(v / z, *bound) for v, bound in zip((x, y), bounds)]
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        (K[0, 0] / z, zero, -K[0, 0] * slopes[0] / z, zero, K[1, 1] / z, -K[1, 1] * slopes[1] / z),
        -1,
    ).view(-1, 2, 3)
    axes = rotation @ quats_to_matrices(quats) * scales[:, None, :]
    cov = jacobian @ axes @ axes.mT @ jacobian.mT
    a, b, c = cov[:, 0, 0] + eps2d, cov[:, 0, 1], cov[:, 1, 1] + eps2d
    det = a * c - b * b
    kept_shares = ((a - eps2d) * (c - eps2d) - b * b).clamp_min(0).div(det).sqrt()
    conics = torch.stack((c / det, -b / det, a / det), -1)
    means2d = torch.stack((K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]), -1)
    with torch.no_grad():
        extent = (2 * (opacities / MIN_ALPHA).log()).sqrt().clamp_max(3.33)
        radii = (extent[:, None] * torch.stack((a, c), -1).sqrt()).ceil()
        size = torch.tensor([width, height])
        kept = (z >= near_plane) & (z <= far_plane) & (det > 0) & (opacities >= MIN_ALPHA)
        kept &= ((means2d + radii > 0) & (means2d - radii < size)).all(-1)
        radii = torch.where(kept[:, None], radii, 0.0).int()
    index = kept.nonzero().flatten()

    def unset(values: Tensor) -> Tensor:
        blank = torch.full_like(values.detach(), torch.nan)
        return blank.index_copy(0, index, values[index])[None]

    shares = unset(kept_shares) if calc_compensations else None
    return radii[None], unset(means2d), unset(z), unset(conics), shares


def spherical_harmonics(degrees_to_use: int, dirs: Tensor, coeffs: Tensor) -> Tensor:
    bands = (degrees_to_use + 1) ** 2
    assert bands <= coeffs.shape[-2] and dirs.shape[0] == coeffs.shape[0]
    basis = sh_basis(torch.nn.functional.normalize(dirs, dim=-1), degrees_to_use)
    return (basis[..., None] * coeffs[:, :bands]).sum(-2)


@torch.no_grad()
def isect_tiles(
    means2d: Tensor, radii: Tensor, depths: Tensor, tile_size: int, tiles_x: int, tiles_y: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Tiles of each row, keys tile << 32 | bits of depth, and rows, both sorted by key."""
    assert means2d.shape == (*depths.shape, 2) == radii.shape and radii.dtype == torch.int32
    counts, keys, members = [], [], []
    bits = depths[0].contiguous().view(torch.int32).long()
    for row in range(depths.shape[1]):
        if (radii[0, row] <= 0).any():
            counts.append(0)
            continue
        low = ((means2d[0, row] - radii[0, row]) / tile_size).floor().clamp_min(0).long().tolist()
        high = ((means2d[0, row] + radii[0, row]) / tile_size).ceil().long().tolist()
        tiles = [
            line * tiles_x + column
            for line in range(low[1], min(high[1], tiles_y))
            for column in range(low[0], min(high[0], tiles_x))
        ]
        counts.append(len(tiles))
        keys += [tile << 32 | int(bits[row]) for tile in tiles]
        members += [row] * len(tiles)
    ordered, order = torch.tensor(keys, dtype=torch.int64).sort(stable=True)
    return torch.tensor(counts), ordered, torch.tensor(members, dtype=torch.int32)[order]


@torch.no_grad()
def isect_offset_encode(keys: Tensor, images: int, tiles_x: int, tiles_y: int) -> Tensor:
    assert images == 1
    tiles = torch.arange(tiles_x * tiles_y)
    return torch.searchsorted(keys >> 32, tiles).int().view(1, tiles_y, tiles_x)


def rasterize_to_pixels(
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
    width: int,
    height: int,
    tile_size: int,
    starts: Tensor,
    members: Tensor,
) -> tuple[Tensor, Tensor]:
    """Image [1, H, W, channels] and alpha [1, H, W, 1]."""
    channels, tiles_x = colors.shape[-1], starts.shape[2]
    if not 0 < channels <= 513:
        raise ValueError(f"Unsupported number of color channels: {channels}")
    values = torch.cat((colors[0], torch.ones_like(opacities[0])[:, None]), -1)
    image = values.new_zeros(height * width, channels + 1)
    ends = torch.cat((starts.flatten()[1:], torch.tensor([len(members)]))).tolist()
    where, found = [], []
    for tile, (start, end) in enumerate(zip(starts.flatten().tolist(), ends)):
        if start == end:
            continue
        rows = members[start:end].long()
        top, left = (tile_size * i for i in divmod(tile, tiles_x))
        y, x = torch.meshgrid(
            torch.arange(top, min(top + tile_size, height)),
            torch.arange(left, min(left + tile_size, width)),
            indexing="ij",
        )
        y, x = y.flatten(), x.flatten()
        dx = means2d[0, rows, 0] - (x[:, None] + 0.5)
        dy = means2d[0, rows, 1] - (y[:, None] + 0.5)
        a, b, c = conics[0, rows].unbind(-1)
        sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
        alpha = (opacities[0, rows] * torch.exp(-sigma)).clamp_max(MAX_ALPHA)
        alpha = torch.where((sigma >= 0) & (alpha >= MIN_ALPHA), alpha, 0.0)
        after = torch.cumprod(1 - alpha, -1)
        before = torch.cat((torch.ones_like(after[:, :1]), after[:, :-1]), -1)
        weights = torch.where(after > MIN_TRANSMITTANCE, before * alpha, 0.0)
        where.append(y * width + x)
        found.append(weights @ values[rows])
    if where:
        image = image.index_copy(0, torch.cat(where), torch.cat(found))
    image = image.view(1, height, width, -1)
    return image[..., :-1], image[..., -1:]
