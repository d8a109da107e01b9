"""What several controllers share: the window of refinements, and clones and split children."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from hoigs.core.gaussians import Gaussians
from hoigs.core.rotation import quats_to_matrices
from hoigs.core.topology import TopologyChange


@dataclass(frozen=True)
class Window:
    """The steps at which there are refinements.

    Attributes:
        start, stop: of the window, fractions of all steps. interval: steps between refinements.
    """

    start: float
    stop: float
    interval: int

    def contains(self, step: int, total_steps: int) -> bool:
        return self.start * total_steps <= step <= self.stop * total_steps

    def refines(self, step: int, total_steps: int) -> bool:
        return self.contains(step, total_steps) and step > 0 and step % self.interval == 0

    def left(self, step: int, total_steps: int) -> int:
        """How many refinements there are from `step` on, it included."""
        first = max(step, math.ceil(self.start * total_steps), 1)
        last = min(math.floor(self.stop * total_steps), total_steps)
        return max(0, last // self.interval - (first - 1) // self.interval)


def with_children(
    rest: Gaussians,
    kept: Bool[Tensor, " N"],
    extra: Int[Tensor, " N"],
    large: Bool[Tensor, " N"],
    generator: torch.Generator,
) -> tuple[TopologyChange, Gaussians]:
    """The kept Gaussians and `extra` more of each, as 3DGS makes them (Kerbl et al. 2023, 5.2).

    Small ones stay and are cloned where they stand. A large one gives way to extra + 1 children,
    drawn from it, with standard deviations divided by 0.8 (extra + 1) (1.6 for two). Offsets are
    at rest, as the new centres are. Order: those that stay, clones, children.

    Args:
        rest: the Gaussians at rest. kept: which remain. extra: Gaussians added for each (read
            where kept). large: which are split rather than cloned.
    """
    extra = torch.where(kept, extra, 0)
    split = large & (extra > 0)
    rows = torch.arange(len(rest), device=kept.device)
    stay = rows[kept & ~split]
    clones = rows[~split].repeat_interleave(extra[~split])
    children = rows[split].repeat_interleave(extra[split] + 1)
    source = torch.cat((stay, clones, children))
    order = torch.arange(len(source), device=source.device)
    fresh, drawn = order >= len(stay), order >= len(stay) + len(clones)
    taken = rest[source]
    offsets = drawn[:, None] * drawn_offsets(taken, generator)
    shrink = drawn * (0.8 * (extra[source] + 1)).log()
    born = taken.replace(means=taken.means + offsets, log_scales=taken.log_scales - shrink[:, None])
    return TopologyChange(source, fresh, offsets), born


def drawn_offsets(gaussians: Gaussians, generator: torch.Generator) -> Float[Tensor, "N 3"]:
    """An offset from the centre of each Gaussian, drawn from it."""
    means = gaussians.means
    normal = torch.randn(means.shape, generator=generator, device=means.device, dtype=means.dtype)
    local = normal * gaussians.scales
    return (quats_to_matrices(gaussians.quats) @ local[..., None]).squeeze(-1)


def drawn_rows(
    weights: Float[Tensor, " N"], count: int, generator: torch.Generator
) -> Int[Tensor, " count"]:
    """Rows with probabilities proportional to `weights` >= 0, with replacement; any N.

    (torch.multinomial stops at 2^24 rows.) At least one weight must be positive.
    """
    edges = weights.double().cumsum(0)
    points = torch.rand(count, generator=generator, device=weights.device, dtype=torch.float64)
    found = torch.searchsorted(edges, points * edges[-1], right=True)
    return found.clamp_max(len(weights) - 1)
