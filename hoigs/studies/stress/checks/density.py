"""F40 to F42: density control asked by hand, far beyond what training asks of it."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.density import DensityControl, DensityStatistics, Refinement
from hoigs.core.gaussians import Gaussians
from hoigs.plugins.density.absgrad import AbsoluteGradientDensity
from hoigs.plugins.density.adc import AdaptiveDensity
from hoigs.plugins.density.mcmc import McmcDensity
from hoigs.studies.stress.finding import Finding

CAP = 300
THRESHOLD = 2e-5  # a tenth of 3DGS's


def _cloud(count: int, opacity: float | Float[Tensor, " N"] = 0.5) -> Gaussians:
    points = torch.rand(count, 3, generator=torch.Generator().manual_seed(0))
    rest = Gaussians.from_points(points, scales=0.1)
    values = torch.as_tensor(opacity).expand(count)
    return rest.replace(opacity_logits=torch.logit(values).clone())


def _statistics(count: int, gradient: float) -> DensityStatistics:
    found = DensityStatistics.zeros(count)
    found.gradient_sum += gradient
    found.absolute_sum += gradient
    found.visible_count += 1
    found.max_radius += 1
    return found


def _refine(
    control: DensityControl, rest: Gaussians, gradient: float, step: int
) -> Refinement | None:
    statistics = _statistics(len(rest), gradient)
    return control.refine(rest, rest, statistics, step=step, total_steps=1000, extent=1.0)


def explosion_capped() -> Finding:
    """Thresholds a tenth of the published ones, gradients that all ask: the cap holds."""
    controls: dict[str, DensityControl] = {
        "adc": AdaptiveDensity(cap=CAP, threshold=THRESHOLD, interval=20),
        "absgrad": AbsoluteGradientDensity(
            cap=CAP, threshold=THRESHOLD, split_threshold=THRESHOLD, interval=20
        ),
        "mcmc": McmcDensity(cap=CAP, growth=0.5, interval=20),
    }
    most = {}
    for name, control in controls.items():
        rest, counts = _cloud(20), []
        for step in range(20, 1000, 20):
            decision = _refine(control, rest, 1.0, step)
            if decision is not None and decision.rest is not None:
                rest = decision.rest
            counts.append(len(rest))
        most[name] = max(counts)
    words = ", ".join(f"{name} {count}" for name, count in most.items())
    return Finding(all(count == CAP for count in most.values()), f"most, of {CAP}: {words}")


def late_reset_refused() -> Finding:
    """Opacity resets every 50 steps of 1000: none in the last 15 %."""
    control = AdaptiveDensity(reset_every=50, stop=1.0, interval=10_000)
    rest, steps = _cloud(20), []
    for step in range(1, 1001):
        decision = _refine(control, rest, 0.0, step)
        if decision is not None and decision.reset_opacity is not None:
            steps.append(step)
    return Finding(
        bool(steps) and max(steps) <= 850, f"{len(steps)} resets, the last at step {max(steps)}"
    )


def not_all_pruned() -> Finding:
    """Opacities that a hundredfold penalty has driven to nothing: the fewest are kept."""
    control = AdaptiveDensity(keep=16, interval=10)
    decision = _refine(control, _cloud(200, torch.linspace(1e-6, 1e-4, 200)), 0.0, 100)
    left = 200 if decision is None or decision.rest is None else len(decision.rest)
    again = None if decision is None else decision.rest
    if again is not None:
        second = _refine(control, again, 0.0, 110)
        left = left if second is None or second.rest is None else len(second.rest)
    return Finding(left == 16, f"{left} of 200 left after two refinements, 16 asked for")
