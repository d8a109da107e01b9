"""Values of points that were seen, continued over those that were not."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from hoigs.core.interfaces.body import HEAD_PART
from hoigs.core.interfaces.deformation import Template
from hoigs.core.maths.nearest import nearest

NEIGHBOURS = 8
OPPOSITE = 8.0  # weight of the opposite side's colours; that of all neighbours together is about 1
OPPOSITES = 4  # points there whose mean is taken: colours of single Gaussians are noisy
ASIDE = 0.03  # metres by which a point and its opposite may be apart across the line of sight


def opposite_points(template: Template) -> Int[Tensor, "N k"]:
    """Indices of points on the other side of the body, front or back, -1 where there are none.

    These are the nearest ones of the same part, seen along z, whose normals point the other way.
    Bodies face +z in their zero pose, their limbs lie across it. The head has none: hair is not a
    face.
    """
    found = torch.full_like(template.parts, -1)[:, None].repeat(1, OPPOSITES)
    flat = template.points * template.points.new_tensor([1, 1, 0])
    front = template.normals[:, 2] > 0
    for part in template.parts.unique().tolist():
        for side in (True, False):
            own = ((template.parts == part) & (front == side)).nonzero()[:, 0]
            others = ((template.parts == part) & (front != side)).nonzero()[:, 0]
            if part == HEAD_PART or not len(own) or len(others) < OPPOSITES:
                continue
            index, apart = nearest(flat[own], OPPOSITES, flat[others])
            close = apart[:, -1] < ASIDE
            found[own[close]] = others[index][close]
    return found


def spread(
    values: Float[Tensor, "N D"],
    seen: Float[Tensor, " N"],
    points: Float[Tensor, "N 3"],
    mirror: Tensor | None = None,
    opposite: Int[Tensor, "N k"] | None = None,
) -> Float[Tensor, "N D"]:
    """Values of what was seen, continued smoothly over what was not.

    Minimises sum_i s_i / (1 - s_i) |y_i - x_i|^2 + sum_ij w_ij |y_i - y_j|^2 over the graph that
    joins each point with its nearest neighbours, of weight 1 together, and with its mirror image.
    Where points have opposite ones, OPPOSITE (1 - s_i)^4 s' |y_i - x'|^2 is added, with the mean s'
    of their s, and the mean x' of their values, weighed by s.

    Args:
        seen: s, in [0, 1]. mirror: index of each point's mirror image, int64 [N].
        opposite: indices of each point's opposite ones, -1 without any.
    """
    from scipy import sparse  # on use: scipy takes a while to import
    from scipy.sparse.linalg import splu

    count = len(points)
    near = nearest(points, NEIGHBOURS)[0].cpu().numpy()
    ends, degree = near.ravel(), near.shape[1]
    starts = np.repeat(np.arange(count), degree)
    weights = np.full(len(ends), 1 / max(1, degree))
    if mirror is not None:
        ends = np.concatenate((ends, mirror.cpu().numpy()))
        starts = np.concatenate((starts, np.arange(count)))
        weights = np.concatenate((weights, np.ones(count)))
    graph = sparse.coo_matrix((weights, (starts, ends)), (count, count)).tocsr()
    graph = (graph + graph.T) / 2
    laplacian = sparse.diags(np.asarray(graph.sum(1)).ravel()) - graph
    s = seen.double().cpu().numpy()
    data = s / (1.0001 - s) + 1e-6  # what is cut off from all that was seen stays
    given = values.double().cpu().numpy()
    known = data[:, None] * given
    if opposite is not None:
        others = opposite.cpu().numpy()
        shares = np.where(others >= 0, s[others], 0.0)
        weight = OPPOSITE * (1 - s) ** 4 * shares.mean(1)
        means = (shares[..., None] * given[others]).sum(1) / (shares.sum(1)[:, None] + 1e-9)
        data, known = data + weight, known + weight[:, None] * means
    found = splu((sparse.diags(data) + laplacian).tocsc()).solve(known)
    return torch.from_numpy(found).to(values)
