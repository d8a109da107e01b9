"""What is known of a body's pose before it is seen: how it rests and how far it turns."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.preparation.body.normal_equations import NormalEquations
from hoigs.preparation.body.priors.joint_limits import beyond
from hoigs.preparation.body.start.flat import relaxed

# joint -> standard deviation from rest, radians; of the others FREE
SPREADS = {
    3: 0.25, 6: 0.2, 9: 0.2, 12: 0.3, 15: 0.3, 13: 0.2, 14: 0.2, 7: 0.35, 8: 0.35,
    10: 0.1, 11: 0.1, 20: 0.6, 21: 0.6,
}  # fmt: skip
FREE = 1.2
FOUND = 0.3  # radians that a pose by another program is off, of every joint
LIMIT = 0.1  # radians beyond a joint's limit that are as rare as one standard deviation
LASTS = 0.3  # seconds: frames nearer than this are no evidence of their own of how a body rests


class PosePrior:
    """Departures of the 21 body joints from rest and beyond their limits.

    Args:
        turns: axis-angle of the joints as another program has found them, in place of rest.
    """

    def __init__(self, turns: Float[Tensor, "F 21 3"] | None = None) -> None:
        self.rest = (relaxed() if turns is None else turns).double().flatten(-2)
        spread = torch.full((21, 3), FREE, dtype=torch.float64)
        for joint, angle in SPREADS.items():
            spread[joint - 1] = angle
        if turns is not None:
            spread[:] = FOUND
        self.precision = spread.flatten().pow(-2)

    def add(
        self,
        body: Float[Tensor, "F 63"],
        share: Float[Tensor, " F"],
        equations: NormalEquations | None,
    ) -> Float[Tensor, ""]:
        """Cost, twice the negative logarithm of the density; adds to the equations, if any."""
        excess = beyond(body.unflatten(-1, (21, 3))).flatten(1)
        off = body - self.rest
        weight = self.precision * share[:, None]
        if equations is not None:
            equations.by_frame[:, 6:] += weight * off + excess / LIMIT**2
            equations.blocks[0].diagonal(dim1=1, dim2=2)[:, 6:] += weight + (excess != 0) / LIMIT**2
        return (weight * off.square()).sum() + (excess / LIMIT).square().sum()
