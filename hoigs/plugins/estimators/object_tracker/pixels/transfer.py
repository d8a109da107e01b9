"""Labels of pixels from frames in which they are known: by similar patches nearby."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

REACH, STRIDE, PATCH = 6, 2, 5  # cells that patches are searched in, their grid, their side


def transferred(
    colors: Float[np.ndarray, "n n 3"],
    known: list[tuple[Float[np.ndarray, "n n 3"], Float[np.ndarray, "n n"]]],
    softness: float = 12.0,
) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n n"]]:
    """Probability of each pixel by the labels of similar patches, and how similar these are.

    Args:
        known: colours and soft mask of windows of the same size, centred on the object.
    """
    import torch
    from torch.nn import functional as F

    def tensor(a: np.ndarray) -> torch.Tensor:
        a = a[..., None] if a.ndim == 2 else a
        return torch.from_numpy(np.ascontiguousarray(a)).permute(2, 0, 1)[None]

    shifts = range(-REACH, REACH + 1, STRIDE)
    here = tensor(colors)
    n, m = colors.shape[:2]
    costs, labels = [], []
    for theirs, mask in known:
        padded = F.pad(tensor(theirs), [REACH] * 4, mode="replicate")
        soft = F.pad(tensor(mask), [REACH] * 4, mode="replicate")
        for dy in shifts:
            for dx in shifts:
                y, x = REACH + dy, REACH + dx
                away = (padded[..., y : y + n, x : x + m] - here).pow(2).sum(1)
                costs.append(away + 0.15 * (dy * dy + dx * dx))
                labels.append(soft[0, :, y : y + n, x : x + m])
    cost = torch.stack(costs, 1)
    for size in ((PATCH, 1), (1, PATCH)):  # a square's mean, one axis after the other
        half = tuple(side // 2 for side in size)
        cost = F.avg_pool2d(cost, size, 1, half, count_include_pad=False)
    cost = cost[0]
    label = torch.cat(labels)
    least = cost.min(0).values
    weight = torch.exp(-(cost - least) / softness)
    prior = (weight * label).sum(0) / weight.sum(0)
    return prior.numpy(), torch.exp(-least / 150).numpy()


def shift_of(
    colors: Float[np.ndarray, "N N 3"],
    template: Float[np.ndarray, "n n 3"],
    soft: Float[np.ndarray, "n n"],
    odds: Float[np.ndarray, "N N"],
    slack: float,
) -> tuple[float, float, float]:
    """Where the template's object lies in a larger window: shift x, y of the middle, and the error.

    The sum of squared differences over the mask, by correlation; `odds` of the pixels help where
    the object turns, and places off the middle cost a little.
    """
    from scipy.signal import fftconvolve

    weight = soft / max(soft.sum(), 1e-6)

    def correlate(image: np.ndarray, kernel: np.ndarray) -> np.ndarray:
        return fftconvolve(image, kernel[::-1, ::-1], mode="valid")

    error = correlate((colors**2).sum(-1), weight) + float((weight[..., None] * template**2).sum())
    for c in range(3):
        error = error - 2 * correlate(colors[..., c], weight * template[..., c])
    error = np.maximum(error, 0) / 120
    error = np.minimum(error, 4) - 0.6 * correlate(np.tanh(odds), weight)
    rows, columns = error.shape
    y, x = np.mgrid[:rows, :columns]
    y, x = y - (rows - 1) / 2, x - (columns - 1) / 2
    error = error + 0.5 * (np.hypot(x, y) / slack) ** 2
    k = np.unravel_index(error.argmin(), error.shape)
    return float(x[k]), float(y[k]), float(error[k])
