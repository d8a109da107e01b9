"""Linear blend skinning of points and of their orientations."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.clock import constant
from hoigs.core.rotation import matrices_to_quats, normalize_quats


def ancestry(parents: Sequence[int]) -> Float[Tensor, "J J"]:
    """One where the column's joint is the row's joint itself or one of its ancestors."""
    table = torch.eye(len(parents))
    for joint, parent in enumerate(parents):
        if parent >= 0:
            table[joint] += table[parent]
    return table


def skin_points(
    points: Float[Tensor, "N 3"],
    weights: Float[Tensor, "N J"],
    transforms: Float[Tensor, "J 4 4"],
) -> Float[Tensor, "N 3"]:
    """LBS: sum_j w_j T_j p."""
    blended = (weights @ transforms[:, :3].flatten(1)).unflatten(1, (3, 4))
    return (blended[:, :, :3] @ points[..., None]).squeeze(-1) + blended[:, :, 3]


def skin_quats(
    weights: Float[Tensor, "N J"],
    transforms: Float[Tensor, "J 4 4"],
    parents: Sequence[int],
    ancestors: Float[Tensor, "J J"],
) -> Float[Tensor, "N 4"]:
    """Unit quaternions of the blended joint rotations: their weighted average.

    Averaged matrices shrink and may flip (the "candy wrapper", methods F25); averaged quaternions
    stay rotations. q and -q are the same rotation, so each joint's sign is first chosen to agree
    with its parent's, all the way from the root; `ancestors` is `ancestry(parents)`.
    """
    quats = matrices_to_quats(transforms[:, :3, :3])
    with torch.no_grad():
        above = constant(tuple(max(p, 0) for p in parents), quats, torch.long)
        above = quats.index_select(0, above)
        flipped = ((quats * above).sum(-1) < 0).to(quats)
        signs = 1 - 2 * torch.remainder(ancestors @ flipped, 2)
    return normalize_quats(weights @ (quats * signs[:, None]))
