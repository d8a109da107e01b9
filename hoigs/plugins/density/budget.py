"""density:budget: exactly as many Gaussians as asked for (Taming 3DGS, Mallick et al. 2024)."""

from __future__ import annotations

from typing import Self

import torch
from jaxtyping import Bool, Float, Int
from pydantic import Field
from torch import Tensor

from hoigs.core.config import ComponentConfig
from hoigs.core.context import BuildContext
from hoigs.core.density import (
    DensityControl,
    DensityStatistics,
    Refinement,
    entity_seed,
    step_generator,
)
from hoigs.core.errors import HoigsError
from hoigs.core.gaussians import Gaussians
from hoigs.plugins.density.children import Window, with_children

# Taming 3DGS's weights of what is known of a Gaussian without drawing it anew
GRADIENT, OPACITY, RADIUS, VOLUME = 25.0, 100.0, 10.0, 25.0


class BudgetDensityConfig(ComponentConfig):
    """A count, and the curve to it.

    Attributes:
        count: Gaussians at the end of the window, exactly; more or fewer than at the start.
        start, stop: of the window in which the count follows the curve, fractions of all steps
            (published: 500 and 15 000 of 30 000). interval: steps between refinements.
        threshold: screen-space gradient, in units of half the image; those above it are chosen
            before all others, as long as they suffice.
        clone_scale: largest scale to be cloned, larger ones are split; fraction of the extent.
        prune_opacity: below it, Gaussians are replaced.
    """

    count: int = Field(ge=1)
    start: float = Field(0.02, ge=0, le=1)
    stop: float = Field(0.5, ge=0, le=1)
    interval: int = Field(100, ge=1)
    threshold: float = Field(2e-4, ge=0)
    clone_scale: float = Field(0.01, gt=0)
    prune_opacity: float = Field(0.005, ge=0, lt=1)


class BudgetDensity(DensityControl):
    """Growth along a given curve to a given count, where it matters most.

    Taming 3DGS's eq. 2 with its published slope goes from S to B in n refinements as
    A(x) = B - (B - S)(1 - x / n)^2: fast, then ever slower. Each refinement therefore shrinks the
    remaining gap by ((left - 1) / left)^2, and the last closes it. The count is never above
    max(S, B), and is B from the last refinement on.

    What grows is drawn without replacement in proportion to a score: sum over views of their
    loss, times 25 gradient + 100 opacity + 10 radius + 25 volume, each over its median (their
    per-view part, which needs renders of its own, is left out). Small ones are cloned and large
    ones split, as in 3DGS. When there are fewer Gaussians than are to be added, each gets several.
    When there are too many, those with the lowest score go.

    Args: as BudgetDensityConfig. seed: of draws and of the children's places.

    Raises:
        HoigsError: from `refine`, when no refinement falls into the window.
    """

    def __init__(
        self,
        count: int,
        start: float = 0.02,
        stop: float = 0.5,
        interval: int = 100,
        threshold: float = 2e-4,
        clone_scale: float = 0.01,
        prune_opacity: float = 0.005,
        seed: int = 0,
    ) -> None:
        self.window, self.count, self.seed = Window(start, stop, interval), count, seed
        self.cap = count  # of more than that at the start, fewer come
        self.threshold, self.clone_scale = threshold, clone_scale
        self.prune_opacity = prune_opacity

    @classmethod
    def from_config(cls, config: BudgetDensityConfig, context: BuildContext) -> Self:
        return cls(**config.model_dump(), seed=entity_seed(context))

    @torch.no_grad()
    def refine(
        self,
        rest: Gaussians,
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
                f"{self.count} Gaussians cannot be reached; lower `interval` or widen the window"
            )
        if not self.window.refines(step, total_steps) or len(rest) == 0:
            return None
        target = self.target(len(rest), self.window.left(step, total_steps))
        score = importance(rest, statistics)
        alive = self._alive(rest, score, target)
        generator = step_generator(self.seed, step, rest.means.device)
        asking = statistics.mean_gradient >= self.threshold
        extra = shares(target - int(alive.sum()), score, alive, asking, generator)
        if alive.all() and not extra.any():
            return None
        large = current.scales.amax(1) > self.clone_scale * extent
        return Refinement(*with_children(rest, alive, extra, large, generator))

    def target(self, count: int, left: int) -> int:
        """The count after this refinement.

        Args:
            count: before it. left: refinements in the rest of the window, this one included.
        """
        gap = (self.count - count) * ((left - 1) / left) ** 2
        return self.count - round(gap)

    def _alive(
        self, rest: Gaussians, score: Float[Tensor, " N"], target: int
    ) -> Bool[Tensor, " N"]:
        """Which stay: what can be seen, and of these the best if they are too many."""
        opacities = rest.opacities
        alive = opacities >= self.prune_opacity
        if not alive.any():  # something must be left to grow from
            alive = opacities >= opacities.median()
        if int(alive.sum()) <= target:
            return alive
        best = torch.where(alive, score, -1.0).topk(target).indices
        chosen = torch.zeros_like(alive)
        chosen[best] = True
        return chosen


def importance(rest: Gaussians, statistics: DensityStatistics) -> Float[Tensor, " N"]:
    """Taming 3DGS's score of each Gaussian (sec. 3.2), as far as statistics tell; 0 if unseen."""
    weighted = (
        GRADIENT * over_median(statistics.mean_gradient)
        + OPACITY * over_median(rest.opacities)
        + RADIUS * over_median(statistics.max_radius)
        + VOLUME * over_median(rest.scales.prod(1))
    )
    return statistics.loss_sum * weighted


def over_median(values: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """Values over the median of those that are positive; 0 where they are not."""
    positive = values > 0
    if not positive.any():
        return torch.zeros_like(values)
    return torch.where(positive, values / values[positive].median(), 0.0)


def shares(
    wanted: int,
    score: Float[Tensor, " N"],
    alive: Bool[Tensor, " N"],
    asking: Bool[Tensor, " N"],
    generator: torch.Generator,
) -> Int[Tensor, " N"]:
    """How many Gaussians each adds, `wanted` in all: full rounds of the living, then a draw.

    The draw is without replacement, by score (Gumbel's top-k is such a draw), and takes those that
    ask for it before the others.
    """
    rounds, drawn = divmod(max(0, wanted), int(alive.sum()))
    extra = torch.where(alive, rounds, 0)
    uniform = torch.rand(score.shape, generator=generator, device=score.device, dtype=torch.float64)
    keys = score.double().clamp_min(1e-30).log() - (-uniform.clamp_min(1e-300).log()).log()
    keys = torch.where(alive, keys + 1e6 * asking, -torch.inf)
    extra[keys.topk(drawn).indices] += 1
    return extra
