"""deformation:linear-displacement: each Gaussian moves along a line, as Ex4DGS's static ones."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import Residual, displaced


class LinearDisplacementConfig(ComponentConfig):
    """No settings."""


class LinearDisplacement(DeformationModel):
    """x(t) = x + d t, with d a parameter `displacement` [N, 3], metres over the clip, 0 at first.

    Times outside [0, 1] are held at the ends. The penalty "displacement" is the mean of
    log(|d| + 0.001) (Ex4DGS, train.py), which pulls small displacements to zero.
    """

    provides = frozenset({"velocity"})
    input_space = "world"
    per_gaussian: tuple[str, ...] = ("displacement",)
    rates: ClassVar[Mapping[str, str]] = {"displacement": "keyframes"}
    regularizer_weights: ClassVar[Mapping[str, float]] = {"displacement": 1e-4}

    displacement: nn.Parameter

    def bind(self, canonical: Gaussians) -> None:
        self.displacement = nn.Parameter(torch.zeros_like(canonical.means))

    def forward(
        self, canonical: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        means = canonical.means + self.displacement * min(max(moment.time, 0.0), 1.0)
        return canonical.replace(means=displaced(means, residual))

    def velocity(self, canonical: Gaussians, moment: Moment) -> Float[Tensor, "N 3"]:
        """Metres per unit time."""
        del canonical, moment
        return self.displacement

    def regularizers(self) -> dict[str, Tensor]:
        if len(self.displacement) == 0:
            return {}
        return {"displacement": torch.log(self.displacement.norm(dim=-1) + 0.001).mean()}
