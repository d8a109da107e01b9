"""F40 to F42: direct checks of density control with extreme statistics."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.interfaces.density import DensityControl, DensityStatistics, Refinement
from hoigs.core.values.gaussians import Gaussians
from hoigs.studies.stress.case import CheckResult
from hoigs.studies.stress.checks.toy import component

CAP = 300
THRESHOLD = 2e-5  # a tenth of 3DGS's


def _cloud(count: int, opacity: float | Float[Tensor, " N"] = 0.5) -> Gaussians:
    points = torch.rand(count, 3, generator=torch.Generator().manual_seed(0))
    canonical = Gaussians.from_points(points, scales=0.1)
    values = torch.as_tensor(opacity).expand(count)
    return canonical.replace(opacity_logits=torch.logit(values).clone())


def _statistics(count: int, gradient: float) -> DensityStatistics:
    found = DensityStatistics.zeros(count)
    found.gradient_sum += gradient
    found.absolute_sum += gradient
    found.visible_count += 1
    found.max_radius += 1
    return found


def _refine(
    control: DensityControl, canonical: Gaussians, gradient: float, step: int
) -> Refinement | None:
    statistics = _statistics(len(canonical), gradient)
    return control.refine(canonical, canonical, statistics, step=step, total_steps=1000, extent=1.0)


def explosion_capped() -> CheckResult:
    """Thresholds a tenth of the published ones and large gradients everywhere: the cap holds."""
    common = {"cap": CAP, "interval": 20}
    controls: dict[str, DensityControl] = {
        "adc": component("density:adc", threshold=THRESHOLD, **common),
        "absgrad": component(
            "density:absgrad", threshold=THRESHOLD, split_threshold=THRESHOLD, **common
        ),
        "mcmc": component("density:mcmc", growth=0.5, **common),
    }
    most = {}
    for name, control in controls.items():
        canonical, counts = _cloud(20), []
        for step in range(20, 1000, 20):
            decision = _refine(control, canonical, 1.0, step)
            if decision is not None and decision.canonical is not None:
                canonical = decision.canonical
            counts.append(len(canonical))
        most[name] = max(counts)
    words = ", ".join(f"{name} {count}" for name, count in most.items())
    return CheckResult(all(count == CAP for count in most.values()), f"most, of {CAP}: {words}")


def late_reset_refused() -> CheckResult:
    """Opacity resets every 50 steps of 1000: none in the last 15 %."""
    control = component("density:adc", reset_every=50, stop=1.0, interval=10_000)
    canonical, steps = _cloud(20), []
    for step in range(1, 1001):
        decision = _refine(control, canonical, 0.0, step)
        if decision is not None and decision.reset_opacity is not None:
            steps.append(step)
    return CheckResult(
        bool(steps) and max(steps) <= 850, f"{len(steps)} resets, the last at step {max(steps)}"
    )


def not_all_pruned() -> CheckResult:
    """Opacities near zero everywhere: the least number of Gaussians is kept."""
    control = component("density:adc", keep=16, interval=10)
    decision = _refine(control, _cloud(200, torch.linspace(1e-6, 1e-4, 200)), 0.0, 100)
    left = 200 if decision is None or decision.canonical is None else len(decision.canonical)
    again = None if decision is None else decision.canonical
    if again is not None:
        second = _refine(control, again, 0.0, 110)
        left = left if second is None or second.canonical is None else len(second.canonical)
    return CheckResult(
        left == 16, f"{left} of 200 left after two refinements, at least 16 required"
    )
