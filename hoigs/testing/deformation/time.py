"""D09: continuity in time."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor

from hoigs.core.maths.rotations import quats_to_matrices
from hoigs.testing.compare import require
from hoigs.testing.deformation.subject import CHECKS, DeformationSubject, continuous

GRID, STEEPEST, HALVINGS = 64, 3, 18
JUMP = 1e-4  # metres, radians, and units of the other fields


@CHECKS.check("D09", continuous)
@torch.no_grad()
def output_is_continuous_in_time(subject: DeformationSubject) -> None:
    """The output does not jump where it changes most."""
    entity = subject.entity(dtype=torch.float64)

    def at(time: float) -> Tensor:
        drawn = subject.draw(entity, time)
        turns = quats_to_matrices(drawn.quats)
        looks = (drawn.log_scales, drawn.opacity_logits[:, None], drawn.sh)
        return torch.cat([x.flatten(1) for x in (drawn.means, turns, *looks)], 1)

    times = [-0.05 + 1.1 * i / GRID for i in range(GRID + 1)]
    values = [at(time) for time in times]
    spans = [(float((b - a).abs().max()), i) for i, (a, b) in enumerate(pairwise(values))]
    for _, i in sorted(spans, reverse=True)[:STEEPEST]:
        low, high, a, b = times[i], times[i + 1], values[i], values[i + 1]
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            c = at(middle)
            if (c - a).abs().max() > (b - c).abs().max():
                high, b = middle, c
            else:
                low, a = middle, c
        jump = float((b - a).abs().max())
        require(
            jump < JUMP,
            f"it jumps by {jump:.3g} at time {low:.6f}; if this is intended, declare "
            "continuous = False",
        )
