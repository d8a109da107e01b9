"""What is known of a body's pose before it is seen: how it rests, how far and how fast it turns."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.preparation.body.flat_start import relaxed
from hoigs.preparation.body.joint_limits import bounds
from hoigs.preparation.body.normal_equations import NormalEquations

# joint -> standard deviation from rest, radians; of the others FREE
SPREADS = {
    3: 0.25, 6: 0.2, 9: 0.2, 12: 0.3, 15: 0.3, 13: 0.2, 14: 0.2, 7: 0.35, 8: 0.35,
    10: 0.1, 11: 0.1, 20: 0.35, 21: 0.35,
}  # fmt: skip
FREE = 1.2
LIMIT = 0.1  # radians beyond a joint's limit that are as rare as one standard deviation
TURNING = 30.0  # rad/s^2 of a joint: CMU's basketball players, 6 to 100
LASTS = 0.3  # seconds: frames nearer than this are no evidence of their own of how a body rests


class PosePrior:
    """Departures of the 21 body joints from rest, beyond their limits, and their accelerations."""

    def __init__(self) -> None:
        self.rest = relaxed().double().flatten()
        spread = torch.full((21, 3), FREE, dtype=torch.float64)
        for joint, angle in SPREADS.items():
            spread[joint - 1] = angle
        self.precision = spread.flatten().pow(-2)
        self.low, self.high = (bound.double().flatten() for bound in bounds())

    def add(
        self,
        body: Float[Tensor, "F 63"],
        share: Float[Tensor, " F"],
        equations: NormalEquations | None,
    ) -> Float[Tensor, ""]:
        """Cost, twice the negative logarithm of the density; adds to the equations, if any."""
        beyond = (body - self.high).clamp_min(0) - (self.low - body).clamp_min(0)
        off = body - self.rest
        weight = self.precision * share[:, None]
        if equations is not None:
            equations.by_frame[:, 6:] += weight * off + beyond / LIMIT**2
            equations.blocks[0].diagonal(dim1=1, dim2=2)[:, 6:] += weight + (beyond != 0) / LIMIT**2
        return (weight * off.square()).sum() + (beyond / LIMIT).square().sum()
