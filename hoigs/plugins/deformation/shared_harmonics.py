"""deformation:shared-harmonics: entities that do not move, with view-dependent colour mixed from a
few shared sets of SH coefficients."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import Residual, displaced


class SharedHarmonicsConfig(ComponentConfig):
    """The shared SH coefficients; their degree is the block's `sh_degree`."""

    lobes: int = Field(default=3, ge=1)
    """Number of sets of SH coefficients that all Gaussians share. No more than 3 (B - 1) can
    differ, for B coefficients a colour, and no more are made."""


class SharedHarmonics(DeformationModel):
    """sh_i = [base_i, sum_k shares_ik lobes_k]: coefficients above degree 0 have rank `lobes`.

    Indoor scenes have few lights, so their view-dependent colours are alike, yet 3DGS learns 24
    numbers for them at each Gaussian (degree 2). Here these are `shares` [N, lobes], and `lobes`
    [lobes, B - 1, 3] once for all; `base` [N, 3] starts as the colour of the canonical Gaussians,
    whose own `sh` is not trained.
    """

    Config: ClassVar = SharedHarmonicsConfig
    input_space = "world"
    moves = False
    cuda_graph_safe = True
    owns = frozenset({"sh"})
    per_gaussian = ("base", "shares")
    rates: ClassVar[Mapping[str, str]] = dict.fromkeys(("base", "shares", "lobes"), "sh")

    base: nn.Parameter
    shares: nn.Parameter
    lobes: nn.Parameter

    def __init__(self, config: SharedHarmonicsConfig | None = None) -> None:
        super().__init__()
        self.config = config or SharedHarmonicsConfig()

    def bind(self, canonical: Gaussians) -> None:
        bands = canonical.sh.shape[1] - 1
        count = min(self.config.lobes, 3 * bands)
        start = torch.empty(count, 3 * bands)
        if count:
            nn.init.orthogonal_(start)  # different ones, each of length 1
        self.lobes = nn.Parameter(start.unflatten(1, (bands, 3)).to(canonical.sh))
        self.shares = nn.Parameter(canonical.sh.new_zeros(len(canonical), count))
        self.base = nn.Parameter(canonical.sh[:, 0].detach().clone())

    def harmonics(self) -> Float[Tensor, "N B 3"]:
        """All coefficients of every Gaussian."""
        higher = torch.einsum("nk,kbc->nbc", self.shares, self.lobes)
        return torch.cat((self.base[:, None], higher), dim=1)

    def forward(
        self, canonical: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        means = displaced(canonical.means, residual)
        return canonical.replace(means=means, sh=self.harmonics())
