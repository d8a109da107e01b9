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
        fresh: True for a clone or split child, whose optimizer moments start at zero.
        offsets: displacement of each new Gaussian from its source, metres, to be added to any
            position that a deformation keeps per Gaussian (all its keyframes alike).
    """

    source: Int[Tensor, " M"]
    fresh: Bool[Tensor, " M"]
    offsets: Float[Tensor, "M 3"]

    @staticmethod
    def keep(mask: Bool[Tensor, " N"]) -> TopologyChange:
        """Prune: keep the rows where `mask` is True."""
        source = mask.nonzero().squeeze(1)
        return TopologyChange(
            source,
            torch.zeros_like(source, dtype=torch.bool),
            torch.zeros(len(source), 3, device=mask.device),
        )

    def __len__(self) -> int:
        return self.source.shape[0]


def reindex(parameters: Iterable[nn.Parameter], change: TopologyChange) -> None:
    """Rows of per-Gaussian parameters follow `change`; the Parameter objects stay the same.

    Keeping the objects means that optimizer groups need no surgery, only their state does.
    """
    for parameter in parameters:
        parameter.grad = None
        parameter.data = parameter.data[change.source].contiguous()
