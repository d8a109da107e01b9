"""The nearest neighbours of points."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor


def nearest(
    points: Float[Tensor, "N 3"], count: int, among: Float[Tensor, "M 3"] | None = None
) -> tuple[Int[Tensor, "N k"], Float[Tensor, "N k"]]:
    """Indices and float64 distances of each point's nearest neighbours, nearest first.

    Args:
        count: k; it is less if there are fewer neighbours.
        among: where the neighbours are searched; by default the other points.
    """
    from scipy.spatial import cKDTree  # on use: scipy takes a while to import

    itself = among is None
    others = _array(points if among is None else among)
    ranks = np.arange(1, min(count, len(others) - itself) + 1) + itself
    if len(ranks) == 0:
        empty = torch.zeros(len(points), 0, dtype=torch.float64, device=points.device)
        return empty.long(), empty
    distances, indices = cKDTree(others).query(_array(points), k=ranks)
    return (
        torch.as_tensor(indices, dtype=torch.int64, device=points.device),
        torch.as_tensor(distances, device=points.device),
    )


def _array(points: Float[Tensor, "N 3"]) -> np.ndarray:
    return points.detach().cpu().double().numpy()
