"""What one frame shows of a flat thing laid over all others: a homography of each.

A mask alone says little where hands and highlights cut it, and colours alone nothing where there
are none: both count, and where there is a texture it counts more. All frames move at once; in
between each takes over what suits it better of its neighbours near and far, so that what one frame
has found spreads (as PatchMatch does over pixels, Barnes et al. 2009).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.preparation.objects.alignment import Crops

CELLS, EXTENT = 34, 0.85  # of the template, along a side; of half a crop's side
COARSE, FINE = (4.0, 3.0), (1.2, 12.0)  # blur, pixels of a crop; colours' weight against masks'
ROUNDS, STEPS, LAST, RATE = 5, 15, 40, 0.04
JUMPS = (1, 2, 4, 8, 16)  # frames to the neighbours of a round
LOOKS = 24  # frames that the most typical one is chosen from, and against
TOLERANCE = 1e-6


@dataclass(frozen=True)
class Sheet:
    """What one crop shows, and what all show, of masks and colours at one blur.

    Attributes:
        grid: places in the crop, -1 to 1. mask, colors: of the template there.
        maps: of all crops: the mask, what is not hidden, and three colours.
        photo: weight of the colours' correlation against the masks' overlap, which hands and
            highlights make less exact.
    """

    grid: Float[Tensor, "P 2"]
    mask: Float[Tensor, " P"]
    colors: Float[Tensor, "3 P"]
    maps: Float[Tensor, "C 5 S S"]
    photo: float

    @staticmethod
    def of(crops: Crops, row: int, level: tuple[float, float]) -> Sheet:
        """Args:
        level: blur, pixels of a crop, and the colours' weight.
        """
        free = torch.maximum(1 - crops.hidden, crops.masks)
        maps = torch.cat((crops.masks, free, crops.features(level[0])), 1)
        line = EXTENT * ((torch.arange(CELLS) + 0.5) / CELLS * 2 - 1)
        grid = torch.cartesian_prod(line, line).flip(-1)
        values = _sampled(maps[row : row + 1], grid[None])[0]
        return Sheet(grid, values[0], values[2:], maps, level[1])

    def costs(
        self, maps: Float[Tensor, "C 3 3"]
    ) -> tuple[Float[Tensor, " C"], Float[Tensor, " C"], Float[Tensor, " C"]]:
        """Of homographies from the template to every crop: cost, overlap of the masks, and
        correlation of the colours."""
        values = _sampled(self.maps, through(maps, self.grid))
        mask, free, colors = values[:, 0], values[:, 1], values[:, 2:]
        weight = torch.maximum(mask, free)
        both = (weight * torch.minimum(mask, self.mask)).sum(-1)
        share = both / (weight * torch.maximum(mask, self.mask)).sum(-1).clamp_min(TOLERANCE)
        weight = self.mask * mask
        weight = (weight / weight.sum(-1, keepdim=True).clamp_min(TOLERANCE))[:, None]
        own = self.colors - (weight * self.colors).sum(-1, keepdim=True)
        theirs = colors - (weight * colors).sum(-1, keepdim=True)
        dot, one, two = ((weight * v).sum((1, 2)) for v in (own * theirs, own**2, theirs**2))
        alike = dot / (one * two + TOLERANCE).sqrt()
        return (1 - share) + self.photo * (1 - alike), share, alike


def _sampled(maps: Float[Tensor, "C 5 S S"], xy: Float[Tensor, "C P 2"]) -> Float[Tensor, "C 5 P"]:
    return torch.nn.functional.grid_sample(maps, xy[:, None], align_corners=False)[:, :, 0]


def through(maps: Float[Tensor, "*N 3 3"], places: Float[Tensor, "P 2"]) -> Float[Tensor, "*N P 2"]:
    """Places through homographies."""
    found = torch.nn.functional.pad(places, (0, 1), value=1.0) @ maps.mT
    return found[..., :2] / found[..., 2:].clamp_min(0.05)


def templates_of(crops: Crops) -> list[int]:
    """Rows to lay over the others: of that half of them which is most like all, just as they are,
    the one that shows most of the thing, that which shows as much as most do, and the most typical.
    """
    rows = np.linspace(0, len(crops) - 1, min(LOOKS, len(crops))).round().astype(int)
    some = crops.rows(rows)
    same = torch.eye(3).expand(len(some), 3, 3)
    totals = [float(Sheet.of(some, k, COARSE).costs(same)[0].sum()) for k in range(len(some))]
    typical = np.argsort(totals)[: -(-len(rows) // 2)]
    areas = (some.masks.sum((1, 2, 3)) / some.K[:, 0, 0].square()).numpy()
    by_area = typical[areas[typical].argsort()]
    return list(dict.fromkeys(rows[[by_area[-1], by_area[len(by_area) // 2], typical[0]]].tolist()))


def laid_over(crops: Crops, row: int) -> Float[Tensor, "C 3 3"]:
    """Homographies from a crop to every other, in their coordinates from -1 to 1."""
    sheet, count = Sheet.of(crops, row, COARSE), len(crops)
    found = torch.eye(3).repeat(count, 1, 1)
    for _ in range(ROUNDS):
        found = _moved(sheet, found, STEPS)
        tried = [found]
        for jump in JUMPS:
            if jump < count:
                tried.append(torch.cat((found[:1].expand(jump, 3, 3), found[:-jump])))
                tried.append(torch.cat((found[jump:], found[-1:].expand(jump, 3, 3))))
        with torch.no_grad():
            best = torch.stack([sheet.costs(maps)[0] for maps in tried]).argmin(0)
        found = torch.stack(tried)[best, torch.arange(count)]
    return _moved(Sheet.of(crops, row, FINE), _moved(sheet, found, STEPS), LAST)


def _moved(sheet: Sheet, start: Float[Tensor, "C 3 3"], steps: int) -> Float[Tensor, "C 3 3"]:
    moved = torch.zeros(len(start), 8, requires_grad=True)
    adam = torch.optim.Adam([moved], lr=RATE, betas=(0.9, 0.98))
    decay = torch.optim.lr_scheduler.ExponentialLR(adam, 0.05 ** (1 / steps))

    def now() -> Tensor:
        change = torch.nn.functional.pad(moved, (0, 1)).unflatten(-1, (3, 3))
        return start @ (torch.eye(3) + change)

    for _ in range(steps):
        adam.zero_grad()
        sheet.costs(now())[0].sum().backward()
        adam.step()
        decay.step()
    return now().detach()
