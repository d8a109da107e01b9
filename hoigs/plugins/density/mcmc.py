"""density:mcmc: Gaussians as samples that move, a count that only grows (3DGS-MCMC)."""

from __future__ import annotations

from typing import Self

import torch
from jaxtyping import Float
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
from hoigs.core.rotation import quats_to_matrices
from hoigs.core.topology import TopologyChange
from hoigs.plugins.density.children import Window, drawn_offsets, drawn_rows
from hoigs.plugins.density.frame_cap import Cap, cap_in
from hoigs.plugins.density.relocation import MAX_COPIES, divided

SHARPNESS = 100.0  # of the gate of the noise


class McmcDensityConfig(ComponentConfig):
    """3DGS-MCMC's numbers, with windows as fractions of the run so that short runs have them too.

    Attributes:
        start, stop: of the window of relocation and growth, fractions of all steps (published:
            500 and 25 000 of 30 000). interval: steps between refinements.
        cap: most Gaussians there may be; "auto" goes by the size of the frames (`frame_cap`).
        growth: by which the count grows at each refinement.
        dead_opacity: at or below it, a Gaussian is relocated; it is also the middle of the noise's
            gate, and the least opacity that a division leaves.
        spread: how far a copy stands from the place that it joins, in standard deviations of what
            is there; published is 0. Short runs give the noise no time to part copies: after 400
            steps on the built-in clip (128 px, 4000 Gaussians, static) half of them still coincide
            and 0 scores 21.2 dB, 0.3 21.5, 1 21.6, where density:adc has 21.7.
        noise: of the exploration, times the learning rate of the positions; 0 is none. It has the
            unit 1 / m^2. Published is 5e5 with a rate of 1.6e-4 x extent; the default here is a
            fifth, because `train.rates.means` is five times theirs: the product is the same.
        opacity_weight, scale_weight: of the penalties "opacity_l1" and "scale_l1" (metres).
    """

    start: float = Field(1 / 60, ge=0, le=1)
    stop: float = Field(5 / 6, ge=0, le=1)
    interval: int = Field(100, ge=1)
    cap: Cap = 60_000
    growth: float = Field(0.05, ge=0)
    dead_opacity: float = Field(0.005, gt=0, lt=1)
    spread: float = Field(0.0, ge=0)
    noise: float = Field(1e5, ge=0)
    opacity_weight: float = Field(0.01, ge=0)
    scale_weight: float = Field(0.01, ge=0)


class McmcDensity(DensityControl):
    """3D Gaussian Splatting as Markov Chain Monte Carlo (Kheradmand et al., NeurIPS 2024).

    At each refinement, Gaussians that are all but transparent move to others that are drawn in
    proportion to opacity, and the count grows by a fraction of itself up to the cap, by the same
    draw. A place that n Gaussians then share keeps its look: opacity and scale follow eq. 9 (see
    `relocation`). Nothing is ever removed, cloned as it stands, or reset; a count that is above
    the cap from the start stays.

    After every step all positions take Langevin noise (eq. 8): rate x noise x gate x Sigma eta,
    eta ~ N(0, I), gate = sigmoid(100 (dead_opacity - opacity)), so that in effect only what is
    nearly transparent wanders. Penalties on opacities and scales (eq. 10) make useless Gaussians
    die, to be used elsewhere.

    Optimizer moments of all rows that share a place start anew. (Published code resets those of
    the place and leaves a moved row the few moments of where it died; after one step both agree.)
    Where a deformation keys opacities, a Gaussian is judged by its largest over time, each key is
    divided by eq. 9, and the scale follows the largest. Relocation takes a row's whole motion from
    its new place: keyframes are those of the source.

    Args: as McmcDensityConfig. seed: of draws and noise.
    """

    cap: int

    def __init__(
        self,
        start: float = 1 / 60,
        stop: float = 5 / 6,
        interval: int = 100,
        cap: int = 60_000,
        growth: float = 0.05,
        dead_opacity: float = 0.005,
        spread: float = 0.0,
        noise: float = 1e5,
        opacity_weight: float = 0.01,
        scale_weight: float = 0.01,
        seed: int = 0,
    ) -> None:
        self.window = Window(start, stop, interval)
        self.cap, self.growth, self.dead_opacity = cap, growth, dead_opacity
        self.spread, self.noise = spread, noise
        self.regularizer_weights = {"opacity_l1": opacity_weight, "scale_l1": scale_weight}
        self.seed = seed

    @classmethod
    def from_config(cls, config: McmcDensityConfig, context: BuildContext) -> Self:
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
        del current, statistics, extent
        if not self.window.refines(step, total_steps) or len(rest) == 0:
            return None
        generator = step_generator(self.seed, step, rest.means.device)
        change, moved = self._relocated(rest, generator)
        change, grown = self._grown(change, moved, generator)
        if change.copies is None or not (change.copies > 1).any():
            return None
        return Refinement(change, grown)

    def _relocated(
        self, rest: Gaussians, generator: torch.Generator
    ) -> tuple[TopologyChange, Gaussians]:
        """Dead rows become copies of living ones, drawn by opacity."""
        opacities = rest.opacities
        dead = opacities <= self.dead_opacity
        source = torch.arange(len(rest), device=dead.device)
        if dead.any() and not dead.all():
            living = torch.where(dead, 0.0, opacities)
            source[dead] = drawn_rows(living, int(dead.sum()), generator)
        return self._shared(rest, source, generator)

    def _grown(
        self, change: TopologyChange, moved: Gaussians, generator: torch.Generator
    ) -> tuple[TopologyChange, Gaussians]:
        """More rows at the end, drawn by opacity; both index maps in one."""
        count = len(moved)
        added = max(0, min(self.cap, int((1 + self.growth) * count)) - count)
        if added == 0:
            return change, moved
        rows = torch.arange(count, device=change.source.device)
        rows = torch.cat((rows, drawn_rows(moved.opacities, added, generator)))
        second, grown = self._shared(moved, rows, generator)
        assert change.copies is not None
        assert second.copies is not None
        joined = TopologyChange(
            change.source[second.source],
            change.fresh[second.source] | second.fresh,
            change.offsets[second.source] + second.offsets,
            change.copies[second.source] * second.copies,
        )
        return joined, grown

    def _shared(
        self, rest: Gaussians, source: Tensor, generator: torch.Generator
    ) -> tuple[TopologyChange, Gaussians]:
        """Rows of `rest` by `source`; those that are taken several times are divided."""
        taken = torch.bincount(source, minlength=len(rest))
        copies = taken[source].clamp_max(MAX_COPIES)
        shared = divided(rest[source], copies, self.dead_opacity)
        offsets = torch.zeros_like(shared.means)
        if self.spread > 0:
            joins = source != torch.arange(len(source), device=source.device)
            offsets = self.spread * joins[:, None] * drawn_offsets(rest[source], generator)
            shared = shared.replace(means=shared.means + offsets)
        return TopologyChange(source, copies > 1, offsets, copies), shared

    @torch.no_grad()
    def perturb(
        self, rest: Gaussians, *, step: int, total_steps: int, rate: float
    ) -> Float[Tensor, "N 3"] | None:
        """Sigma eta, gated by opacity: eq. 8 of the paper, to the end of the run."""
        del total_steps
        size = rate * self.noise
        if size == 0 or len(rest) == 0:
            return None
        means = rest.means
        generator = step_generator(self.seed, step, means.device, stream=1)
        eta = torch.randn(means.shape, generator=generator, device=means.device, dtype=means.dtype)
        gate = torch.sigmoid(SHARPNESS * (self.dead_opacity - rest.opacities))
        # Sigma eta = R S^2 R^T eta, and R^T eta is distributed as eta
        local = eta * rest.scales.square() * (size * gate)[:, None]
        return (quats_to_matrices(rest.quats) @ local[..., None]).squeeze(-1)

    def regularizers(self, current: Gaussians) -> dict[str, Tensor]:
        """ "opacity_l1", "scale_l1" (metres): means over Gaussians (eq. 10)."""
        if len(current) == 0:
            return {}
        return {"opacity_l1": current.opacities.mean(), "scale_l1": current.scales.mean()}
