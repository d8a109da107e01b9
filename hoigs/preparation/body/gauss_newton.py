"""Gauss-Newton on the energy of the body fit."""

from __future__ import annotations

from collections.abc import Callable

from hoigs.preparation.body.fit_problem import FitProblem
from hoigs.preparation.body.fit_values import Unknowns
from hoigs.preparation.body.kinematics import PER_FRAME
from hoigs.preparation.body.normal_equations import NormalEquations

DAMPING, STUCK = 1e-3, 1e4
ESTIMATED = (6, 9, 12)  # steps before which the landmarks' noise is estimated anew
RESCALED = (4, 8, 11)
SETTLED = 14  # steps after which nothing but convergence is left to wait for
ENOUGH_GAIN = 1e-3  # of the energy, below which a step is the last


def solve(problem: FitProblem, steps: int, progress: Callable[[float], None] | None) -> Unknowns:
    """Gauss-Newton with Marquardt's damping, until steps change next to nothing."""
    unknowns, damping = problem.begin, DAMPING
    for step in range(steps):
        # the robust spread narrows, so that a poor start is not taken for outliers
        widen = max(1.0, 5.0 - step)
        if step in RESCALED:
            unknowns = problem.rescale(unknowns)
        if step in ESTIMATED:
            problem.estimate_noise(unknowns)
        unknowns = problem.carry(unknowns, step / min(steps, SETTLED))
        better, damping, gain = _improved(problem, unknowns, widen, damping)
        unknowns = better
        if progress is not None:
            progress((step + 1) / steps)
        if step >= SETTLED and gain < ENOUGH_GAIN:
            break
    if progress is not None:
        progress(1.0)
    return unknowns


def _improved(
    problem: FitProblem, unknowns: Unknowns, widen: float, damping: float
) -> tuple[Unknowns, float, float]:
    """A step downhill, the next damping, and the share of the energy that the step gained; the
    same unknowns and 0 if no step goes down."""
    frames, shared = len(unknowns.pose.transl), problem.count_shared(unknowns)
    equations = NormalEquations(frames, PER_FRAME, shared)
    before = problem.energy(unknowns, widen, equations)
    while damping < STUCK:
        found = equations.step(damping)
        if found is not None:
            moved = unknowns.moved(*found)
            after = problem.energy(moved, widen)
            if after < before:
                return moved, max(damping / 10, 1e-6), (before - after) / abs(before)
        damping *= 10
    return unknowns, DAMPING, 0.0
