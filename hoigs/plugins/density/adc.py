"""density:adc: adaptive density control of 3DGS (Kerbl et al. 2023, Sec. 5.2)."""

from __future__ import annotations

from typing import ClassVar, Literal, Self

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor

from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.density import (
    DensityControl,
    DensityStatistics,
    Refinement,
    entity_seed,
    step_generator,
)
from hoigs.core.values.clip import Clip
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.topology import TopologyChange
from hoigs.plugins.density.children import Cap, Window, resolve_cap, with_children

LATEST_RESET = 0.85  # of the run: opacities do not recover from a reset in the last 15 %


class AdaptiveDensityConfig(ComponentConfig):
    """3DGS's thresholds, with windows as fractions of the run so that short runs have them too."""

    start: float = Field(default=0.02, ge=0, le=1)
    """Start of the window in which Gaussians are added and removed, as a fraction of all steps
    (3DGS: step 500 of 30 000)."""
    stop: float = Field(default=0.5, ge=0, le=1)
    """Its end (3DGS: step 15 000 of 30 000)."""
    interval: int = Field(default=100, ge=1)
    """Steps between refinements."""
    threshold: float = Field(default=2e-4, gt=0)
    """Screen-space gradient, in units of half the image, above which a Gaussian is cloned or split.
    """
    cap: Cap = 60_000
    """Largest number of Gaussians; "auto" depends on the size of the frames (`frame_cap`)."""
    keep: int = Field(default=16, ge=1)
    """Number of Gaussians that pruning always leaves."""
    clone_scale: float = Field(default=0.01, gt=0)
    """Gaussians up to this scale are cloned, larger ones are split; fraction of the extent."""
    prune_opacity: float = Field(default=0.005, ge=0, lt=1)
    """Gaussians of lower opacity are pruned."""
    prune_scale: float | None = Field(default=None, gt=0)
    """Gaussians of larger scale are pruned too, fraction of the extent; None (as 3DGS without
    resets) prunes none."""
    prune_radius: float | None = Field(default=None, gt=0)
    """Gaussians of larger screen radius are pruned too, pixels; None prunes none."""
    reset_every: int | None = Field(default=None, ge=1)
    """Steps between opacity resets (3DGS: 3000); None never resets, which suits short runs. There
    are no resets in the last 15 % of the run."""
    reset_opacity: float = Field(default=0.01, gt=0, lt=1)
    """Largest opacity after a reset."""


class AdaptiveDensity(DensityControl):
    """Clone small Gaussians, split large ones, prune transparent ones, up to a cap.

    A large Gaussian is split into two, with standard deviations divided by 1.6. When more Gaussians
    exceed the threshold than the cap allows, those with the largest gradients are refined. A
    Gaussian is pruned only if its largest opacity over time is low, since a keyed opacity may be
    low at one moment alone.

    Children of a split are drawn from their parent in canonical space, so the offsets of the
    TopologyChange are in canonical coordinates; a deformation that keeps its own positions
    rotates them as it rotates the Gaussian.

    Args:
        seed: seed of the children's positions. clip: its frame size decides a cap of "auto".
    """

    Config: ClassVar = AdaptiveDensityConfig
    cap: int

    def __init__(
        self,
        config: AdaptiveDensityConfig | None = None,
        *,
        seed: int = 0,
        clip: Clip | None = None,
    ) -> None:
        self.config = config = config or self.Config()
        self.window = Window(config.start, config.stop, config.interval)
        self.cap, self.seed = resolve_cap(config.cap, clip), seed

    @classmethod
    def from_config(cls, config: AdaptiveDensityConfig, context: BuildContext) -> Self:
        return cls(config, seed=entity_seed(context), clip=context.clip)

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
        refines = self.window.refines(step, total_steps)
        resets = self.window.contains(step, total_steps) and self._resets(step, total_steps)
        if not refines and not resets:
            return None
        change, children = None, None
        if refines:
            generator = step_generator(self.seed, step, canonical.means.device)
            change, children = self._change(canonical, current, statistics, extent, generator)
        return Refinement(change, children, self.config.reset_opacity if resets else None)

    def _resets(self, step: int, total_steps: int) -> bool:
        every = self.config.reset_every
        if every is None or step == 0 or step % every:
            return False
        return step <= LATEST_RESET * total_steps

    def urgency(
        self, statistics: DensityStatistics, large: Bool[Tensor, " N"]
    ) -> Float[Tensor, " N"]:
        """The gradient over its threshold; Gaussians of 1 and more are cloned or split."""
        return statistics.mean_gradient / self.config.threshold

    def _change(
        self,
        canonical: Gaussians,
        current: Gaussians,
        statistics: DensityStatistics,
        extent: float,
        generator: torch.Generator,
    ) -> tuple[TopologyChange, Gaussians] | tuple[None, None]:
        """The index map and the new canonical Gaussians; (None, None) when nothing changes."""
        pruned = self._pruned(canonical, current, statistics, extent)
        large = current.scales.amax(1) > self.config.clone_scale * extent
        urgency = self.urgency(statistics, large)
        refined = (urgency >= 1) & ~pruned
        allowed = max(0, self.cap - int((~pruned).sum()))
        if int(refined.sum()) > allowed:
            chosen = torch.where(refined, urgency, -1.0).topk(allowed).indices
            refined = torch.zeros_like(refined)
            refined[chosen] = True
        if not refined.any() and not pruned.any():
            return None, None
        return with_children(canonical, ~pruned, refined.long(), large, generator)

    def _pruned(
        self, canonical: Gaussians, current: Gaussians, statistics: DensityStatistics, extent: float
    ) -> Bool[Tensor, " N"]:
        config = self.config
        opacity = torch.maximum(canonical.opacities, current.opacities)
        pruned = opacity < config.prune_opacity
        if config.prune_scale is not None:
            pruned |= current.scales.amax(1) > config.prune_scale * extent
        if config.prune_radius is not None:
            pruned |= statistics.max_radius > config.prune_radius
        if int((~pruned).sum()) < config.keep:
            pruned[opacity.topk(min(config.keep, len(opacity))).indices] = False
        return pruned


# density:absgrad: adaptive density control by absolute screen gradients.
#
# AbsGS (Ye et al. 2024, arXiv:2404.10484).


class AbsoluteGradientConfig(AdaptiveDensityConfig):
    """As density:adc, with another criterion for splitting.

    AbsGS's code also sets clone_scale to 0.001, a tenth of 3DGS's.
    """

    split_threshold: float = Field(default=4e-4, gt=0)
    """Absolute gradient, in units of half the image, above which a large Gaussian is split (AbsGS's
    code: 4e-4)."""
    clone: Literal["signed", "absolute"] = "signed"
    """The gradient that `threshold` is compared with for small Gaussians, "signed" (AbsGS) or
    "absolute". gsplat's absgrad is "absolute" with 8e-4 for both thresholds."""


class AbsoluteGradientDensity(AdaptiveDensity):
    """Adaptive density control by gradients that do not cancel between the pixels of a Gaussian.

    The pixels of a large Gaussian over fine detail pull it in all directions at once. Their signed
    sum, which 3DGS compares with its threshold, is then small, and the blur stays. AbsGS sums the
    absolute values of the components over pixels before it takes the norm ("homodirectional"
    gradient), and splits by that. It needs a rasterizer with `Capabilities.absolute_gradients`.
    """

    Config: ClassVar = AbsoluteGradientConfig
    config: AbsoluteGradientConfig
    absolute_gradients = True

    def urgency(
        self, statistics: DensityStatistics, large: Bool[Tensor, " N"]
    ) -> Float[Tensor, " N"]:
        absolute = statistics.mean_absolute_gradient
        small = absolute if self.config.clone == "absolute" else statistics.mean_gradient
        split = absolute / self.config.split_threshold
        return torch.where(large, split, small / self.config.threshold)
