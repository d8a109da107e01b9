"""density:none: the number of Gaussians stays as it is."""

from __future__ import annotations

from hoigs.core.config import ComponentConfig
from hoigs.core.density import DensityControl, DensityStatistics, Refinement
from hoigs.core.gaussians import Gaussians


class NoDensityConfig(ComponentConfig):
    """Nothing to set."""


class NoDensity(DensityControl):
    """Never refines."""

    def refine(
        self,
        rest: Gaussians,
        current: Gaussians,
        statistics: DensityStatistics,
        *,
        step: int,
        total_steps: int,
        extent: float,
    ) -> Refinement | None:
        del rest, current, statistics, step, total_steps, extent
        return None
