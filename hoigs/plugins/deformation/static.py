"""deformation:static: an entity that does not move."""

from __future__ import annotations

from dataclasses import replace

from hoigs.core.config import ComponentConfig
from hoigs.core.deformation import DeformationModel
from hoigs.core.gaussians import Gaussians
from hoigs.core.interaction import Residual
from hoigs.core.moment import Moment


class StaticConfig(ComponentConfig):
    """Nothing to set."""


class Static(DeformationModel):
    """The rest Gaussians at every moment, displaced only by a residual if there is one."""

    rest_space = "world"
    moves = False
    recordable = True

    def forward(
        self, rest: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        del moment
        if residual is None or residual.means is None:
            return rest
        return replace(rest, means=rest.means + residual.means)
