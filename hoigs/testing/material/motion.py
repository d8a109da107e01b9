"""A deformation that provides everything that feature extractors may use."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import Residual
from hoigs.testing.material.body import TinyBody
from hoigs.testing.material.clip import HUMAN


class TinyMotion(DeformationModel):
    """Every Gaussian moves on its own; a field on the tiny body, and tangents at five keyframes."""

    provides = frozenset({"velocity", "field"})
    per_gaussian = ("tangents",)
    input_space = "world"
    field_width = 6
    keyframes = 5

    codes: Tensor

    def __init__(self) -> None:
        super().__init__()
        self._body = (TinyBody(),)
        generator = torch.Generator().manual_seed(21)
        codes = torch.randn(len(self._body[0].vertex_parts), self.field_width, generator=generator)
        self.register_buffer("codes", codes)

    def bind(self, canonical: Gaussians) -> None:
        rows = torch.linspace(0.5, 1.0, max(len(canonical), 1))[: len(canonical), None, None]
        knots = torch.linspace(-1.0, 1.0, self.keyframes)[:, None] * torch.tensor((0.3, 0.1, -0.2))
        self.tangents = nn.Parameter((rows * knots).to(canonical.means))

    def forward(
        self, canonical: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        means = canonical.means + self.tangents.mean(1) + self.tangents[:, -1] * moment.time
        if residual is not None and residual.means is not None:
            means = means + residual.means
        return canonical.replace(means=means)

    def velocity(self, canonical: Gaussians, moment: Moment) -> Float[Tensor, "N 3"]:
        del canonical, moment
        return self.tangents[:, -1]

    def posed_field(
        self, canonical: Gaussians, moment: Moment
    ) -> tuple[Float[Tensor, "V D"], Float[Tensor, "V 3"]]:
        del canonical
        places = self._body[0](moment.poses[HUMAN]).vertices
        return self.codes + moment.time, places

    def field_parts(self) -> Int[Tensor, " V"]:
        return self._body[0].vertex_parts
