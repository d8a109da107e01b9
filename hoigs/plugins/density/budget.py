"""density:budget: a given number of Gaussians, reached exactly.

Taming 3DGS (Mallick et al. 2024, arXiv:2406.15643).
"""

from __future__ import annotations

from typing import ClassVar, Self

import torch
from jaxtyping import Bool, Float, Int
from pydantic import Field
from torch import Tensor

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.density import (
    DensityControl,
    DensityStatistics,
    Refinement,
    entity_seed,
    step_generator,
)
from hoigs.core.values.gaussians import Gaussians
from hoigs.plugins.density.children import Window, with_children

# weights in Taming 3DGS's score of what is known of a Gaussian without another render
GRADIENT, OPACITY, RADIUS, VOLUME = 25.0, 100.0, 10.0, 25.0


class BudgetDensityConfig(ComponentConfig):
    """The final count, and the curve to it."""

    count: int = Field(ge=1)
    """Exact number of Gaussians at the end of the window; it may be above or below the first."""
    start: float = Field(default=0.02, ge=0, le=1)
    """Start of the window in which the count follows the curve, as a fraction of all steps
    (published: step 500 of 30 000)."""
    stop: float = Field(default=0.5, ge=0, le=1)
    """Its end (published: step 15 000 of 30 000)."""
    interval: int = Field(default=100, ge=1)
    """Steps between refinements."""
    threshold: float = Field(default=2e-4, ge=0)
    """Screen-space gradient, in units of half the image; Gaussians above it are cloned or split
    before all others."""
    clone_scale: float = Field(default=0.01, gt=0)
    """Gaussians up to this scale are cloned, larger ones are split; fraction of the extent."""
    prune_opacity: float = Field(default=0.005, ge=0, lt=1)
    """Gaussians of lower opacity are pruned, and others replace them."""


class BudgetDensity(DensityControl):
    """Growth along a curve to a given count, by an importance score.

    Taming 3DGS's Eq. 2 with its published slope goes from S to B in n refinements as
    A(x) = B - (B - S)(1 - x / n)^2: fast at first, then slower. Each refinement therefore shrinks
    the remaining gap by ((left - 1) / left)^2, and the last one closes it. The count never exceeds
    max(S, B), and is B from the last refinement on.

    The Gaussians that are cloned or split are drawn without replacement, in proportion to a score:
    the sum of the losses of the views in which a Gaussian is seen, times 25 gradient + 100 opacity
    + 10 radius + 25 volume, each over its median (the published terms that need further renders are
    left out). When fewer Gaussians exist than are to be added, each gets several children. When
    there are too many, those with the lowest score are pruned.

    Args:
        seed: seed of draws and of the children's positions.

    Raises:
        HoigsError: from `refine`, when no refinement falls into the window.
    """

    Config: ClassVar = BudgetDensityConfig

    def __init__(self, config: BudgetDensityConfig, *, seed: int = 0) -> None:
        self.config, self.seed = config, seed
        self.window = Window(config.start, config.stop, config.interval)
        self.cap = config.count  # a larger count at the start shrinks to it

    @classmethod
    def from_config(cls, config: BudgetDensityConfig, context: BuildContext) -> Self:
        return cls(config, seed=entity_seed(context))

    @torch.no_grad()
    def refine(
        self,
        canonical: Gaussians,
        current: Gaussians,
        statistics: DensityStatistics,
        *,
        step: int,
        total_steps: int,
        extent: float,
    ) -> Refinement | None:
        if self.window.left(1, total_steps) == 0:
            window = self.window
            raise HoigsError(
                f"density:budget: no refinement falls between {window.start:g} and "
                f"{window.stop:g} of {total_steps} steps at an interval of {window.interval}, so "
                f"{self.config.count} Gaussians cannot be reached; lower `interval` or widen the "
                "window"
            )
        if not self.window.refines(step, total_steps) or len(canonical) == 0:
            return None
        target = self.target(len(canonical), self.window.left(step, total_steps))
        score = importance(canonical, statistics)
        alive = self._alive(canonical, score, target)
        generator = step_generator(self.seed, step, canonical.means.device)
        above = statistics.mean_gradient >= self.config.threshold
        extra = shares(target - int(alive.sum()), score, alive, above, generator)
        if alive.all() and not extra.any():
            return None
        large = current.scales.amax(1) > self.config.clone_scale * extent
        return Refinement(*with_children(canonical, alive, extra, large, generator))

    def target(self, count: int, left: int) -> int:
        """The count after this refinement.

        Args:
            count: before it. left: refinements in the rest of the window, this one included.
        """
        gap = (self.config.count - count) * ((left - 1) / left) ** 2
        return self.config.count - round(gap)

    def _alive(
        self, canonical: Gaussians, score: Float[Tensor, " N"], target: int
    ) -> Bool[Tensor, " N"]:
        """Which Gaussians stay: the visible ones, or the `target` best of these."""
        opacities = canonical.opacities
        alive = opacities >= self.config.prune_opacity
        if not alive.any():  # something must remain to be cloned
            alive = opacities >= opacities.median()
        if int(alive.sum()) <= target:
            return alive
        best = torch.where(alive, score, -1.0).topk(target).indices
        chosen = torch.zeros_like(alive)
        chosen[best] = True
        return chosen


def importance(canonical: Gaussians, statistics: DensityStatistics) -> Float[Tensor, " N"]:
    """Taming 3DGS's score of each Gaussian (Sec. 3.2), from the statistics alone; 0 if unseen."""
    weighted = (
        GRADIENT * over_median(statistics.mean_gradient)
        + OPACITY * over_median(canonical.opacities)
        + RADIUS * over_median(statistics.max_radius)
        + VOLUME * over_median(canonical.scales.prod(1))
    )
    return statistics.loss_sum * weighted


def over_median(values: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """Values over the median of those that are positive; 0 where they are not."""
    positive = values > 0
    if not positive.any():
        return torch.zeros_like(values)
    return torch.where(positive, values / values[positive].median(), 0.0)


def shares(
    count: int,
    score: Float[Tensor, " N"],
    alive: Bool[Tensor, " N"],
    above: Bool[Tensor, " N"],
    generator: torch.Generator,
) -> Int[Tensor, " N"]:
    """How many children each Gaussian gets, `count` in all: the same for each, the rest drawn.

    The draw is without replacement, in proportion to the score (top-k of Gumbel keys), and takes
    the Gaussians `above` the threshold before the others.
    """
    rounds, drawn = divmod(max(0, count), int(alive.sum()))
    extra = torch.where(alive, rounds, 0)
    uniform = torch.rand(score.shape, generator=generator, device=score.device, dtype=torch.float64)
    keys = score.double().clamp_min(1e-30).log() - (-uniform.clamp_min(1e-300).log()).log()
    keys = torch.where(alive, keys + 1e6 * above, -torch.inf)
    extra[keys.topk(drawn).indices] += 1
    return extra
