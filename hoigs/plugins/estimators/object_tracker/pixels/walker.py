"""A soft mask that follows edges: a random walker with priors."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy import ndimage, sparse
from scipy.sparse.linalg import cg


def walked(
    odds: Float[np.ndarray, "n n"],
    colors: Float[np.ndarray, "n n 3"],
    pull: float = 0.06,
    sharpness: float = 1.0,
) -> Float[np.ndarray, "n n"]:
    """Probability of each pixel to be inside (Grady 2005, multilabel random walks with priors).

    It minimises the sum over neighbours of w (p_i - p_j)^2 and over pixels of pull (p_i - q_i)^2,
    where q is the probability that `odds` gives, and w falls with the difference of colour.
    """
    smooth = ndimage.gaussian_filter(colors, (0.6, 0.6, 0))
    across = ((smooth[:, 1:] - smooth[:, :-1]) ** 2).sum(-1)
    down = ((smooth[1:] - smooth[:-1]) ** 2).sum(-1)
    # the scale of differences comes from the window itself
    unit = 2.0 * (across.mean() + down.mean()) / 2 + 2.0
    across, down = np.exp(-sharpness * across / unit * 2), np.exp(-sharpness * down / unit * 2)
    across, down = across + 1e-3, down + 1e-3
    n, m = odds.shape
    index = np.arange(n * m).reshape(n, m)
    i = np.concatenate((index[:, :-1].ravel(), index[:-1].ravel()))
    j = np.concatenate((index[:, 1:].ravel(), index[1:].ravel()))
    w = np.concatenate((across.ravel(), down.ravel()))
    links = sparse.coo_matrix((w, (i, j)), shape=(n * m, n * m)).tocsr()
    links = links + links.T
    total = np.asarray(links.sum(1)).ravel() + pull
    system = sparse.diags(total) - links
    prior = 1 / (1 + np.exp(-odds.astype(float).ravel()))
    jacobi = sparse.diags(1 / total)
    solved, _ = cg(system, pull * prior, x0=prior, rtol=1e-3, maxiter=60, M=jacobi)
    return solved.reshape(n, m).clip(0, 1).astype(np.float32)
