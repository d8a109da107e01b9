"""More points on the surface that some points lie on."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.maths.nearest import nearest

NEIGHBOURS = 6
LEAST = 8  # points; fewer say little of a surface


def denser(
    points: Float[Tensor, "N 3"], colors: Float[Tensor, "N 3"], count: int, seed: int
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M 3"]]:
    """The points, followed by new ones up to `count`, each between a point and a neighbour of it.

    Colours are blended likewise. Points that are `count` or more, or fewer than LEAST, stay as they
    are.
    """
    generator = torch.Generator().manual_seed(seed)
    while LEAST <= len(points) < count:
        rows, _ = nearest(points, NEIGHBOURS)
        pick = torch.randint(NEIGHBOURS, (len(points), 1), generator=generator)
        share = 0.3 + 0.4 * torch.rand(len(points), 1, generator=generator)
        other = rows.cpu().gather(1, pick)[:, 0].to(points.device)
        chosen = torch.randperm(len(points), generator=generator)[: count - len(points)]
        chosen, share = chosen.to(points.device), share.to(points)
        between = [torch.lerp(x, x[other], share)[chosen] for x in (points, colors)]
        points, colors = (
            torch.cat((old, new)) for old, new in zip((points, colors), between, strict=True)
        )
    return points, colors
