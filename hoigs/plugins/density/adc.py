"""density:adc: 3DGS's adaptive density control (Kerbl et al. 2023, sec. 5.2; methods D.1)."""

from __future__ import annotations

from typing import Self

import torch
from jaxtyping import Bool, Float
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
from hoigs.core.gaussians import Gaussians
from hoigs.core.topology import TopologyChange
from hoigs.plugins.density.children import Window, with_children
from hoigs.plugins.density.frame_cap import Cap, cap_in

LATEST_RESET = 0.85  # a reset in the last 15 % of the run would not be recovered from (F41)


class AdaptiveDensityConfig(ComponentConfig):
    """3DGS's thresholds, with windows as fractions of the run so that short runs have them too.

    Attributes:
        start, stop: of the window in which Gaussians are added and removed, fractions of all
            steps (3DGS: 500 and 15 000 of 30 000). interval: steps between refinements.
        threshold: screen-space gradient, in units of half the image, above which one is refined.
        cap: most Gaussians there may be; "auto" goes by the size of the frames (`frame_cap`).
        keep: fewest that pruning may leave.
        clone_scale: largest scale to be cloned, larger ones are split; fraction of the extent.
        prune_opacity: below it, Gaussians are removed.
        prune_scale: above it too, fraction of the extent; None (as 3DGS without resets) never.
        prune_radius: the same for the screen radius, pixels.
        reset_every: steps between opacity resets (3DGS: 3000); None never resets, as suits
            short runs. Resets in the last 15 % of the run are left out.
        reset_opacity: that a reset leaves.
    """

    start: float = Field(0.02, ge=0, le=1)
    stop: float = Field(0.5, ge=0, le=1)
    interval: int = Field(100, ge=1)
    threshold: float = Field(2e-4, gt=0)
    cap: Cap = 60_000
    keep: int = Field(16, ge=1)
    clone_scale: float = Field(0.01, gt=0)
    prune_opacity: float = Field(0.005, ge=0, lt=1)
    prune_scale: float | None = Field(None, gt=0)
    prune_radius: float | None = Field(None, gt=0)
    reset_every: int | None = Field(None, ge=1)
    reset_opacity: float = Field(0.01, gt=0, lt=1)


class AdaptiveDensity(DensityControl):
    """Clone what is small, split what is large, prune what is not seen, under a hard cap.

    Large ones are split in two, of standard deviations divided by 1.6. When more Gaussians ask for
    refinement than the cap has room for, those with the largest gradients get it. A Gaussian is
    removed for its opacity only if the largest that it has over time is low, since a keyed opacity
    may be low at one moment alone.

    Split children are drawn from their parent at rest, so the offsets of the TopologyChange are in
    rest coordinates, as the new rest centres are; a deformation that keeps positions of its own
    turns them as it turns the Gaussian.

    Args: as AdaptiveDensityConfig. seed: of the children's places.
    """

    cap: int

    def __init__(
        self,
        start: float = 0.02,
        stop: float = 0.5,
        interval: int = 100,
        threshold: float = 2e-4,
        cap: int = 60_000,
        keep: int = 16,
        clone_scale: float = 0.01,
        prune_opacity: float = 0.005,
        prune_scale: float | None = None,
        prune_radius: float | None = None,
        reset_every: int | None = None,
        reset_opacity: float = 0.01,
        seed: int = 0,
    ) -> None:
        self.window, self.seed = Window(start, stop, interval), seed
        self.threshold, self.cap, self.keep = threshold, cap, keep
        self.clone_scale, self.prune_opacity = clone_scale, prune_opacity
        self.prune_scale, self.prune_radius = prune_scale, prune_radius
        self.reset_every, self.reset_opacity = reset_every, reset_opacity

    @classmethod
    def from_config(cls, config: AdaptiveDensityConfig, context: BuildContext) -> Self:
        settings = config.model_dump() | {"cap": cap_in(context, config.cap)}
        return cls(**settings, seed=entity_seed(context))

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
        refines = self.window.refines(step, total_steps)
        resets = self.window.contains(step, total_steps) and self._resets(step, total_steps)
        if not refines and not resets:
            return None
        change, children = None, None
        if refines:
            generator = step_generator(self.seed, step, rest.means.device)
            change, children = self._change(rest, current, statistics, extent, generator)
        return Refinement(change, children, self.reset_opacity if resets else None)

    def _resets(self, step: int, total_steps: int) -> bool:
        if self.reset_every is None or step == 0 or step % self.reset_every:
            return False
        return step <= LATEST_RESET * total_steps

    def urgency(
        self, statistics: DensityStatistics, large: Bool[Tensor, " N"]
    ) -> Float[Tensor, " N"]:
        """The gradient over its threshold: 1 and more asks for refinement."""
        del large
        return statistics.mean_gradient / self.threshold

    def _change(
        self,
        rest: Gaussians,
        current: Gaussians,
        statistics: DensityStatistics,
        extent: float,
        generator: torch.Generator,
    ) -> tuple[TopologyChange, Gaussians] | tuple[None, None]:
        """The index map and the new rest, or nothing when all stay as they are."""
        pruned = self._pruned(rest, current, statistics, extent)
        large = current.scales.amax(1) > self.clone_scale * extent
        urgency = self.urgency(statistics, large)
        wanted = (urgency >= 1) & ~pruned
        room = max(0, self.cap - int((~pruned).sum()))
        if int(wanted.sum()) > room:
            chosen = torch.where(wanted, urgency, -1.0).topk(room).indices
            wanted = torch.zeros_like(wanted)
            wanted[chosen] = True
        if not wanted.any() and not pruned.any():
            return None, None
        return with_children(rest, ~pruned, wanted.long(), large, generator)

    def _pruned(
        self, rest: Gaussians, current: Gaussians, statistics: DensityStatistics, extent: float
    ) -> Bool[Tensor, " N"]:
        opacity = torch.maximum(rest.opacities, current.opacities)
        pruned = opacity < self.prune_opacity
        if self.prune_scale is not None:
            pruned |= current.scales.amax(1) > self.prune_scale * extent
        if self.prune_radius is not None:
            pruned |= statistics.max_radius > self.prune_radius
        if int((~pruned).sum()) < self.keep:
            pruned[opacity.topk(min(self.keep, len(opacity))).indices] = False
        return pruned
