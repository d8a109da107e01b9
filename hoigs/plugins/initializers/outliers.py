"""Points that no surface passes through."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor


def inliers(
    points: Float[Tensor, "P 3"], neighbours: int = 16, ratio: float = 2.5
) -> Bool[Tensor, " P"]:
    """Points about as close to their nearest neighbours as those are to theirs.

    A simple form of the local outlier factor (Breunig et al. 2000). The usual rule, so many
    standard deviations over all points (Rusu et al. 2008), takes away whole sides of an object
    that few frames saw, because they are sparser; here each side is judged by its own density.
    Too few points to judge all stay.

    Args:
        ratio: largest mean distance to the neighbours, over the median of theirs.
    """
    from scipy.spatial import cKDTree  # on use: scipy takes a while to import

    if len(points) <= neighbours:
        return torch.ones(len(points), dtype=torch.bool)
    array = points.double().numpy()
    distances, indices = cKDTree(array).query(array, k=neighbours + 1)
    spacing = distances[:, 1:].mean(1)
    usual = np.median(spacing[indices[:, 1:]], axis=1)
    return torch.from_numpy(np.asarray(spacing <= ratio * np.maximum(usual, 1e-12)))
