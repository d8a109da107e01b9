"""density:mcmc: relocation, growth and noise.

3DGS-MCMC (Kheradmand et al. 2024, arXiv:2404.09591).
"""

from __future__ import annotations

import math
from typing import ClassVar, Self

import torch
from jaxtyping import Float, Int
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
from hoigs.core.maths.rotations import quats_to_matrices
from hoigs.core.values.clip import Clip
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.topology import TopologyChange, share_opacity
from hoigs.plugins.density.children import Cap, Window, drawn_offsets, drawn_rows, resolve_cap

# Replacing a Gaussian by several coinciding ones that look the same (3DGS-MCMC, Eq. 9).

MAX_COPIES = 51  # as published: of more copies the alternating sum would overflow

# BINOMIALS[n, k] = C(n, k); all are below 2^53
BINOMIALS = torch.tensor(
    [[math.comb(n, k) for k in range(MAX_COPIES + 1)] for n in range(MAX_COPIES + 1)],
    dtype=torch.float64,
)


def relocation_shrink(
    opacities: Float[Tensor, " M"], copies: Int[Tensor, " M"]
) -> Float[Tensor, " M"]:
    """Factor by which standard deviations change when a Gaussian becomes n coinciding ones.

    With o' = 1 - (1 - o)^(1 / n), Eq. 9 keeps the integral of alpha along a line
    through the centre. Its double sum is, by the hockey-stick identity sum_i C(i - 1, k) =
    C(n, k + 1), the single one used here:

        sigma' / sigma = o / sum_{k=1}^n C(n, k) (-1)^(k-1) o'^k / sqrt(k)

    Computed in float64; 1 where n is 1.

    Args:
        opacities: o, of the Gaussian before. copies: n, at most MAX_COPIES.
    """
    o = opacities.double().clamp(1e-12, 1.0 - 1e-7)
    shared = -torch.expm1(torch.log1p(-o) / copies)
    k = torch.arange(1, MAX_COPIES + 1, device=o.device, dtype=torch.float64)
    signs = 1.0 - 2.0 * ((k - 1) % 2)
    binomials = BINOMIALS.to(o.device)[copies, 1:]  # zero beyond n, so that terms end there
    total = (binomials * signs * shared[:, None] ** k / k.sqrt()).sum(1)
    return torch.where(copies > 1, o / total, 1.0).to(opacities.dtype)


def shared_among(gaussians: Gaussians, copies: Int[Tensor, " M"], min_opacity: float) -> Gaussians:
    """Each row as one of `copies` coinciding Gaussians that together look like it before.

    Args:
        copies: n of each row, at most MAX_COPIES; rows with one stay. min_opacity: lowest opacity
            of a row with several.
    """
    several = copies > 1
    low, high = math.log(min_opacity / (1 - min_opacity)), -math.log(torch.finfo(torch.float32).eps)
    logits = share_opacity(gaussians.opacity_logits, copies).clamp(low, high)
    log_scales = gaussians.log_scales.clone()
    rows = several.nonzero().squeeze(1)
    shrink = relocation_shrink(gaussians.opacities[rows], copies[rows])
    log_scales[rows] += shrink.log()[:, None]
    return gaussians.replace(
        opacity_logits=torch.where(several, logits, gaussians.opacity_logits), log_scales=log_scales
    )


GATE_STEEPNESS = 100.0


class McmcDensityConfig(ComponentConfig):
    """3DGS-MCMC's settings; its window is in fractions of the run, so that short runs have it."""

    start: float = Field(default=1 / 60, ge=0, le=1)
    """Start of the window of relocation and growth, as a fraction of all steps
    (published: step 500 of 30 000)."""
    stop: float = Field(default=5 / 6, ge=0, le=1)
    """Its end (published: step 25 000 of 30 000)."""
    interval: int = Field(default=100, ge=1)
    """Steps between refinements."""
    cap: Cap = 60_000
    """Largest number of Gaussians; "auto" depends on the size of the frames (`frame_cap`)."""
    growth: float = Field(default=0.05, ge=0)
    """Relative growth of the count at each refinement."""
    dead_opacity: float = Field(default=0.005, gt=0, lt=1)
    """A Gaussian at or below it is relocated; it is also the midpoint of the gate of the noise, and
    the lowest opacity of a copy."""
    spread: float = Field(default=0.0, ge=0)
    """Distance of a copy from its source, in standard deviations of the source; published is 0. In
    short runs the noise has no time to separate copies: after 400 steps on the built-in clip (128
    px, 4000 Gaussians, static) half of them still coincide, and 0 scores 21.2 dB, 0.3 21.5, 1 21.6,
    where density:adc has 21.7."""
    noise: float = Field(default=1e5, ge=0)
    """Strength of the noise, multiplied by the learning rate of the positions; 0 is none; unit
    1 / m^2. Published is 5e5 with a rate of 1.6e-4 x extent. The default here is a fifth, and the
    default of `train.rates.means` 15 times theirs, so the product is three times theirs."""
    opacity_weight: float = Field(default=0.01, ge=0)
    """Weight of the penalty "opacity_l1"."""
    scale_weight: float = Field(default=0.01, ge=0)
    """Weight of the penalty "scale_l1" (metres)."""


class McmcDensity(DensityControl):
    """3D Gaussian Splatting as Markov Chain Monte Carlo (Kheradmand et al., NeurIPS 2024).

    At each refinement, nearly transparent ("dead") Gaussians are relocated to others, which are
    drawn in proportion to opacity, and the count grows by a fraction up to the cap, by the same
    draw. The n Gaussians that then coincide look as the one before: opacity and scale follow Eq. 9
    (`relocation`). Nothing is pruned or reset, and a count above the cap at the start stays.

    After every step all positions get Langevin noise (Eq. 8): rate x noise x gate x Sigma eta,
    eta ~ N(0, I), gate = sigmoid(100 (dead_opacity - opacity)), so that in effect only nearly
    transparent Gaussians move. Penalties on opacities and scales (Eq. 10) make useless Gaussians
    transparent, so that they are relocated.

    Optimizer moments of all coinciding rows are reset. (The published code resets those of the
    source, and leaves a relocated row the few moments of its old position; after one step both
    agree.) Where a deformation keys opacities, the largest over time decides, each key follows
    Eq. 9, and the scale follows the largest. A relocated row takes the keyframes of its source.

    Args:
        seed: seed of draws and noise. clip: its frame size decides a cap of "auto".
    """

    Config: ClassVar = McmcDensityConfig
    cuda_graph_safe = True
    cap: int

    def __init__(
        self, config: McmcDensityConfig | None = None, *, seed: int = 0, clip: Clip | None = None
    ) -> None:
        self.config = config = config or McmcDensityConfig()
        self.window = Window(config.start, config.stop, config.interval)
        self.cap, self.seed = resolve_cap(config.cap, clip), seed
        self.regularizer_weights = {
            "opacity_l1": config.opacity_weight,
            "scale_l1": config.scale_weight,
        }

    @classmethod
    def from_config(cls, config: McmcDensityConfig, context: BuildContext) -> Self:
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
        if not self.window.refines(step, total_steps) or len(canonical) == 0:
            return None
        generator = step_generator(self.seed, step, canonical.means.device)
        change, moved = self._relocated(canonical, generator)
        change, grown = self._grown(change, moved, generator)
        if change.copies is None or not (change.copies > 1).any():
            return None
        return Refinement(change, grown)

    def _relocated(
        self, canonical: Gaussians, generator: torch.Generator
    ) -> tuple[TopologyChange, Gaussians]:
        """Dead rows become copies of others, drawn in proportion to opacity."""
        opacities = canonical.opacities
        dead = opacities <= self.config.dead_opacity
        source = torch.arange(len(canonical), device=dead.device)
        if dead.any() and not dead.all():
            living = torch.where(dead, 0.0, opacities)
            source[dead] = drawn_rows(living, int(dead.sum()), generator)
        return self._shared(canonical, source, generator)

    def _grown(
        self, change: TopologyChange, moved: Gaussians, generator: torch.Generator
    ) -> tuple[TopologyChange, Gaussians]:
        """Append rows, drawn in proportion to opacity; joins both index maps."""
        count = len(moved)
        added = max(0, min(self.cap, int((1 + self.config.growth) * count)) - count)
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
        self, canonical: Gaussians, source: Tensor, generator: torch.Generator
    ) -> tuple[TopologyChange, Gaussians]:
        """Rows of `canonical` by `source`; coinciding copies share opacity and scale."""
        taken = torch.bincount(source, minlength=len(canonical))
        copies = taken[source].clamp_max(MAX_COPIES)
        shared = shared_among(canonical[source], copies, self.config.dead_opacity)
        offsets = torch.zeros_like(shared.means)
        if self.config.spread > 0:
            joins = source != torch.arange(len(source), device=source.device)
            offsets = (
                self.config.spread * joins[:, None] * drawn_offsets(canonical[source], generator)
            )
            shared = shared.replace(means=shared.means + offsets)
        return TopologyChange(source, copies > 1, offsets, copies), shared

    @torch.no_grad()
    def perturb(
        self, canonical: Gaussians, *, step: int, total_steps: int, rate: float
    ) -> Float[Tensor, "N 3"] | None:
        """Langevin noise (Eq. 8): Sigma eta, gated by opacity, until the end of the run."""
        size = rate * self.config.noise
        if size == 0 or len(canonical) == 0:
            return None
        means = canonical.means
        generator = step_generator(self.seed, step, means.device, stream=1)
        eta = torch.randn(means.shape, generator=generator, device=means.device, dtype=means.dtype)
        gate = torch.sigmoid(GATE_STEEPNESS * (self.config.dead_opacity - canonical.opacities))
        # Sigma eta = R S^2 R^T eta, and R^T eta is distributed as eta
        local = eta * canonical.scales.square() * (size * gate)[:, None]
        return (quats_to_matrices(canonical.quats) @ local[..., None]).squeeze(-1)

    def regularizers(self, current: Gaussians) -> dict[str, Tensor]:
        """ "opacity_l1", "scale_l1" (metres): means over Gaussians (Eq. 10)."""
        if len(current) == 0:
            return {}
        return {"opacity_l1": current.opacities.mean(), "scale_l1": current.scales.mean()}
