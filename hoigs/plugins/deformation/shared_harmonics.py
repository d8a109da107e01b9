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
    """How many lobes, and how sharp.

    Attributes:
        lobes: that all Gaussians share. degree: of their spherical harmonics.
    """

    lobes: int = Field(3, ge=1)
    degree: int = Field(2, ge=1, le=3)


class SharedHarmonics(DeformationModel):
    """sh_i = [base_i, sum_k share_ik lobe_k]: bands above the base colour are of rank `lobes`.

    A room is lit by few lamps and shines in few ways, yet 3DGS learns 24 numbers for it at each
    Gaussian (degree 2); here these are `shares` [N, lobes], and `lobes` [lobes, B - 1, 3] once for
    all. Everything else is the rest Gaussians': give them `sh_degree: 0`; bands of their own, if they
    have some, are added to.

    Args:
        lobes, degree: as SharedHarmonicsConfig.
    """

    rest_space = "world"
    moves = False
    recordable = True
    per_gaussian = ("shares",)
    rates: ClassVar[Mapping[str, str]] = {"shares": "sh", "lobes": "sh"}

    shares: nn.Parameter
    lobes: nn.Parameter

    def __init__(self, lobes: int = 3, degree: int = 2) -> None:
        super().__init__()
        self.count, self.bands = lobes, (degree + 1) ** 2 - 1
        if lobes > 3 * self.bands:
            raise ValueError(
                f"{lobes} lobes of degree {degree}: more than {3 * self.bands} are one another's "
                "mixtures; give each Gaussian bands of its own (sh_degree)"
            )

    @classmethod
    def from_config(cls, config: SharedHarmonicsConfig, context: BuildContext) -> Self:
        del context
        return cls(config.lobes, config.degree)

    def bind(self, rest: Gaussians) -> None:
        start = torch.empty(self.count, 3 * self.bands)
        nn.init.orthogonal_(start)  # lobes that differ, each of length 1
        self.lobes = nn.Parameter(start.unflatten(1, (self.bands, 3)).to(rest.sh))
        self.shares = nn.Parameter(rest.sh.new_zeros(len(rest), self.count))

    def harmonics(self) -> Float[Tensor, "N B 3"]:
        """The bands above the base of every Gaussian."""
        return torch.einsum("nk,kbc->nbc", self.shares, self.lobes)

    def forward(
        self, rest: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        del moment
        shine = nn.functional.pad(self.harmonics(), (0, 0, 1, 0))
        missing = rest.sh.shape[1] - shine.shape[1]
        shine = nn.functional.pad(shine, (0, 0, 0, max(missing, 0)))
        moved = replace(rest, sh=nn.functional.pad(rest.sh, (0, 0, 0, max(-missing, 0))) + shine)
        if residual is None or residual.means is None:
            return moved
        return replace(moved, means=rest.means + residual.means)
