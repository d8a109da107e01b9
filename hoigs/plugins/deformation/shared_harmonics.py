"""deformation:shared-harmonics: a still set whose shine is a mixture of a few shared lobes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar, Self

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from hoigs.core.config import ComponentConfig
from hoigs.core.context import BuildContext
from hoigs.core.deformation import DeformationModel
from hoigs.core.gaussians import Gaussians
from hoigs.core.interaction import Residual
from hoigs.core.moment import Moment


class SharedHarmonicsConfig(ComponentConfig):
    """How many lobes; how sharp they are is the block's `sh_degree`.

    Attributes:
        lobes: that all Gaussians share.
    """

    lobes: int = Field(3, ge=1)


class SharedHarmonics(DeformationModel):
    """sh_i = [base_i, sum_k share_ik lobe_k]: bands above the base colour are of rank `lobes`.

    A room is lit by few lamps and shines in few ways, yet 3DGS learns 24 numbers for it at each
    Gaussian (degree 2). Here these are `shares` [N, lobes], and `lobes` [lobes, B - 1, 3] once for
    all; `base` [N, 3] starts as the colour of the rest Gaussians, whose own `sh` is not trained.

    Args:
        lobes: as SharedHarmonicsConfig; no more than 3 (B - 1) can differ, and no more are made.
    """

    rest_space = "world"
    moves = False
    recordable = True
    owns = frozenset({"sh"})
    per_gaussian = ("base", "shares")
    rates: ClassVar[Mapping[str, str]] = dict.fromkeys(("base", "shares", "lobes"), "sh")

    base: nn.Parameter
    shares: nn.Parameter
    lobes: nn.Parameter

    def __init__(self, lobes: int = 3) -> None:
        super().__init__()
        self.count = lobes

    @classmethod
    def from_config(cls, config: SharedHarmonicsConfig, context: BuildContext) -> Self:
        del context
        return cls(config.lobes)

    def bind(self, rest: Gaussians) -> None:
        bands = rest.sh.shape[1] - 1
        count = min(self.count, 3 * bands)
        start = torch.empty(count, 3 * bands)
        if count:
            nn.init.orthogonal_(start)  # lobes that differ, each of length 1
        self.lobes = nn.Parameter(start.unflatten(1, (bands, 3)).to(rest.sh))
        self.shares = nn.Parameter(rest.sh.new_zeros(len(rest), count))
        self.base = nn.Parameter(rest.sh[:, 0].detach().clone())

    def harmonics(self) -> Float[Tensor, "N B 3"]:
        """All bands of every Gaussian."""
        shine = torch.einsum("nk,kbc->nbc", self.shares, self.lobes)
        return torch.cat((self.base[:, None], shine), dim=1)

    def forward(
        self, rest: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        del moment
        moved = replace(rest, sh=self.harmonics())
        if residual is None or residual.means is None:
            return moved
        return replace(moved, means=rest.means + residual.means)
