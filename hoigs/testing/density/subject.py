"""DensitySubject: a controller with its settings, and inputs as of a training run."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.density import DensityControl, DensityStatistics, Refinement
from hoigs.core.values.gaussians import Gaussians
from hoigs.testing.checks import CheckList
from hoigs.testing.material.clip import OBJECT, tiny_clip
from hoigs.testing.modules import DeviceSubject

if TYPE_CHECKING:
    from hoigs.testing.runner import Options

COUNT = 60
TOTAL = 2000  # steps of the simulated run
EXTENT = 2.0
LARGEST = 150_000  # cap that a check still tests, in Gaussians


class DensitySubject(DeviceSubject[DensityControl]):
    """The component under check."""

    def control(self) -> DensityControl:
        return self.cls.from_config(self.config, BuildContext(OBJECT, tiny_clip()))

    def cloud(self, count: int = COUNT, seed: int = 0) -> Gaussians:
        """Gaussians of all sizes, some of them nearly transparent."""
        generator = torch.Generator().manual_seed(seed)

        def normal(*shape: int) -> Tensor:
            return torch.randn(count, *shape, generator=generator)

        cloud = Gaussians(
            means=normal(3),
            quats=normal(4),
            log_scales=normal(3) - 3.5,
            opacity_logits=3 * normal() - 2,
            sh=0.3 * normal(4, 3),
        )
        return cloud.to(self.device)

    def statistics(self, count: int = COUNT, seed: int = 0) -> DensityStatistics:
        """Statistics of some views: a third is above usual thresholds, some were never visible."""
        generator = torch.Generator().manual_seed(100 + seed)

        def uniform() -> Tensor:
            return torch.rand(count, generator=generator)

        seen = torch.randint(0, 5, (count,), generator=generator).float()
        gradient = 6e-4 * uniform() * (uniform() > 0.3)
        made = DensityStatistics(
            gradient_sum=gradient * seen,
            visible_count=seen,
            max_radius=30 * uniform() * (seen > 0),
            absolute_sum=3 * gradient * seen,
            loss_sum=uniform() * seen,
        )
        return DensityStatistics(*(x.to(self.device) for x in vars(made).values()))

    def refine(
        self,
        control: DensityControl,
        step: int,
        canonical: Gaussians,
        statistics: DensityStatistics | None = None,
    ) -> Refinement | None:
        statistics = statistics or self.statistics(len(canonical))
        return control.refine(
            canonical, canonical, statistics, step=step, total_steps=TOTAL, extent=EXTENT
        )

    def first(self, control: DensityControl, canonical: Gaussians) -> tuple[int, Refinement] | None:
        """The first step that changes rows, and the decision; None when none does."""
        seen = self.statistics(len(canonical))
        for step in range(1, TOTAL + 1):
            found = self.refine(control, step, canonical, seen)
            if found is not None and found.change is not None:
                return step, found
        return None


CHECKS: CheckList[DensitySubject] = CheckList("N")


def subject(cls: type[DensityControl], config: Any, options: Options) -> DensitySubject:
    made = DensitySubject(cls, config, torch.device(options.device))
    made.control()
    return made


def changes_rows(subject: DensitySubject) -> str | None:
    found = subject.first(subject.control(), subject.cloud())
    return None if found else f"it changes no rows in {TOTAL} steps"


def caps(subject: DensitySubject) -> str | None:
    cap = subject.control().cap
    if cap is None:
        return "it declares no cap"
    return None if cap <= LARGEST else f"its cap is {cap}: set a smaller one in the settings"


def perturbs(subject: DensitySubject) -> str | None:
    offsets = subject.control().perturb(subject.cloud(), step=7, total_steps=TOTAL, rate=1e-3)
    return None if offsets is not None else "its `perturb` returns no offsets"
