"""Changes of the number of Gaussians: one index map covers prune, clone and split."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn


@dataclass(frozen=True)
class TopologyChange:
    """How M new Gaussians come from the N old ones.

    Attributes:
        source: old row of each new Gaussian.
        fresh: True for a clone, a split child or a relocated row: its optimizer moments start at 0.
        offsets: displacement of each new Gaussian from its source, metres; a deformation adds it
            to every position that it keeps per Gaussian (to all keyframes alike).
        copies: number of new Gaussians that replace the source of each, itself included; they
            share its opacity by `share_opacity`, which the entity applies to `opacity_logits` that
            its deformation keeps per Gaussian. None: each keeps the whole opacity.
    """

    source: Int[Tensor, " M"]
    fresh: Bool[Tensor, " M"]
    offsets: Float[Tensor, "M 3"]
    copies: Int[Tensor, " M"] | None = None

    @staticmethod
    def keep(mask: Bool[Tensor, " N"]) -> TopologyChange:
        """Prune: keep the rows where `mask` is True."""
        source = mask.nonzero().squeeze(1)
        return TopologyChange(
            source,
            torch.zeros_like(source, dtype=torch.bool),
            torch.zeros(len(source), 3, device=mask.device),
        )

    @staticmethod
    def displaced(offsets: Float[Tensor, "N 3"]) -> TopologyChange:
        """Every Gaussian keeps its row and its optimizer moments, and moves by its offset."""
        source = torch.arange(len(offsets), device=offsets.device)
        return TopologyChange(source, torch.zeros_like(source, dtype=torch.bool), offsets)

    def __len__(self) -> int:
        return self.source.shape[0]


@dataclass(frozen=True)
class AxisChange:
    """How a parameter's entries along one axis come from its old ones: knots, or rows of a subset.

    Attributes:
        axis: the axis whose length changes.
        source: old entry of each new one; not read for fresh entries.
        fresh: True for an entry whose optimizer moments start at 0.
    """

    axis: int
    source: Int[Tensor, " M"]
    fresh: Bool[Tensor, " M"]

    def follow(self, values: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
        """Old values, such as Adam's moments, at the new entries; zero where these are fresh."""
        shape = list(values.shape)
        shape[self.axis] = len(self.source)
        followed = values.new_zeros(shape)
        kept = (~self.fresh).nonzero().squeeze(1)
        return followed.index_copy(
            self.axis, kept, values.index_select(self.axis, self.source[kept])
        )


def share_opacity(
    logits: Float[Tensor, "M *rest"], copies: Int[Tensor, " M"]
) -> Float[Tensor, "M *rest"]:
    """Opacity logits of n coincident Gaussians that look like one: o' = 1 - (1 - o)^(1 / n).

    Exact at the centre, where transmittances multiply (3DGS-MCMC, Kheradmand et al. 2024, eq. 9).
    Rows with one copy are left bit for bit.
    """
    shares = copies.reshape(-1, *(1,) * (logits.dim() - 1))
    log_clear = torch.nn.functional.logsigmoid(-logits) / shares  # ln(1 - o')
    shared = torch.log(-torch.expm1(log_clear)) - log_clear
    return torch.where(shares > 1, shared, logits)


def reindex(parameters: Iterable[nn.Parameter], change: TopologyChange) -> None:
    """Rows of per-Gaussian parameters follow `change`; the Parameter objects stay the same.

    So optimizer groups stay as they are, and only the optimizer's state has to follow.
    """
    for parameter in parameters:
        parameter.grad = None
        parameter.data = parameter.data[change.source].contiguous()
