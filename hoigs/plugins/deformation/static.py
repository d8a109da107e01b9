"""deformation:static: an entity that does not move."""

from __future__ import annotations

from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import Residual, displaced


class Static(DeformationModel):
    """The canonical Gaussians at every moment, displaced only by a residual if there is one."""

    input_space = "world"
    moves = False
    cuda_graph_safe = True

    def forward(
        self, canonical: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        means = displaced(canonical.means, residual)
        return canonical if means is canonical.means else canonical.replace(means=means)
