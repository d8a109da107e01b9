"""Formulas as products with tables of coefficients or indices: few operations, on any device.

On a GPU each small operation costs its launch, on a CPU its dispatch. The tables stay on the device
(`hoigs.core.device.constant`), so that CUDA graphs may be captured.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, lru_cache
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.device import constant
from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.maths.skinning import checked_tree

# Coefficients of 1, r, r^2, r^3 (rows) in h00, h10, h01, h11 (columns), and in their derivatives.
HERMITE = (
    (1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (-3.0, -2.0, 3.0, -1.0), (2.0, 1.0, -2.0, 1.0)
)  # fmt: skip
HERMITE_DERIVATIVE = (
    (0.0, 1.0, 0.0, 0.0), (-6.0, -4.0, 6.0, -2.0), (6.0, 3.0, -6.0, 3.0), (0.0, 0.0, 0.0, 0.0)
)  # fmt: skip
# xy, yz, zx, x^2 - y^2 and 3 z^2 - 1 (of unit vectors) from the products xx, xy, xz, yx, ... zz
SECOND_DEGREE = (
    (0.0, 0.0, 0.0, 1.0, -1.0), (1.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0, 0.0),
    (0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, -1.0, -1.0), (0.0, 1.0, 0.0, 0.0, 0.0),
    (0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 2.0),
)  # fmt: skip
IDENTITY = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def hermite_weights(r: Any, *, derivative: bool = False) -> Any:
    """As `splines.hermite_weights`; numbers are left to it."""
    if not isinstance(r, Tensor):
        return NotImplemented
    table = HERMITE_DERIVATIVE if derivative else HERMITE
    weights = r ** constant((0, 1, 2, 3), r) @ constant(table, r)
    return weights.split(1, -1) if r.dim() else weights.unbind()


def irradiance_basis(normals: Float[Tensor, "N 3"]) -> Float[Tensor, "N 8"]:
    """As `spherical_harmonics.irradiance_basis`."""
    products = (normals[:, :, None] * normals[:, None]).flatten(1)
    return torch.cat((normals, products @ constant(SECOND_DEGREE, normals)), -1)


def joint_transforms(
    rotations: Float[Tensor, "*batch J 3"],
    joints: Float[Tensor, "*shape J 3"],
    parents: Sequence[int],
    transl: Float[Tensor, "*batch 3"],
) -> Float[Tensor, "*batch J 4 4"]:
    """As `skinning.joint_transforms`: the chain of each joint doubles in every round, which is 4
    products for a body with hands, where one for each level of the tree would be 12.

    Ancestors are chosen by products with zeros and ones: on CUDA the gradient of an index is summed
    by atomics, in another order every time.
    """
    above, rounds = _choices(tuple(parents), rotations.dtype, rotations.device)
    joints = joints.expand(rotations.shape)
    # an extra joint with the identity transform stands before the root and is its parent
    bases = torch.cat((-transl[..., None, :], joints), -2)
    bones = joints - above @ bases
    local = torch.cat((axis_angle_to_matrices(rotations), bones[..., None]), -1)
    last = constant((0.0, 0.0, 0.0, 1.0), local).expand(*local.shape[:-2], 1, 4)
    local = torch.cat((local, last), -2)
    none = constant(IDENTITY, local).expand(*local.shape[:-3], 1, 4, 4)
    world = torch.cat((none, local), -3)
    for chosen in rounds:
        world = (chosen @ world.flatten(-2)).unflatten(-1, (4, 4)) @ world
    top = world[..., 1:, :3, :]
    rotation, position = top[..., :3], top[..., 3]
    shift = position - (rotation @ joints[..., None])[..., 0]
    return torch.cat((torch.cat((rotation, shift[..., None]), -1), last), -2)


@cache  # never freed, like `constant`
def _choices(
    parents: tuple[int, ...], dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, list[Tensor]]:
    """Matrices that choose each joint's parent, and the ancestors of `_doubling_rounds`."""
    with torch.inference_mode(False):
        unit = torch.eye(len(parents) + 1, dtype=dtype, device=device)
        rounds = [unit[list(indices)] for indices in _doubling_rounds(parents)]
        return unit[[parent + 1 for parent in parents]], rounds


@lru_cache(maxsize=32)
def _doubling_rounds(parents: tuple[int, ...]) -> tuple[tuple[int, ...], ...]:
    """For each round 0, 1, … the index of each joint's ancestor 2^round levels up.

    Index 0 stands for no ancestor, j + 1 for joint j. The last round reaches the root from every
    joint.
    """
    depth: list[int] = []
    for parent in checked_tree(parents):
        depth.append(0 if parent < 0 else depth[parent] + 1)
    above = (0, *(parent + 1 for parent in parents))
    rounds = []
    for _ in range(max(depth).bit_length()):
        rounds.append(above)
        above = tuple(above[index] for index in above)
    return tuple(rounds)
