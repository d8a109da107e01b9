"""density:none: the number of Gaussians does not change."""

from __future__ import annotations

from hoigs.core.interfaces.density import DensityControl, DensityStatistics, Refinement
from hoigs.core.values.gaussians import Gaussians


class NoDensity(DensityControl):
    """Never refines."""

    keeps_all = True

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
        return None
