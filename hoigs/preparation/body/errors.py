"""How far a fitted body may be off from the truth, by what the fit leaves open."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.preparation.body.fit_problem import FitProblem, Unknowns
from hoigs.preparation.body.fitted import BodyErrors
from hoigs.preparation.body.kinematics import JOINTS, PER_FRAME, NormalEquations
from hoigs.preparation.body.landmarks import JOINTS as JOINT_OF

DRAWS = 48
SHOULDERS = [16, 17]  # body joints
VISIBLE = 0.5
SHARE = 0.8  # of the frames, in which the body is to be within its errors
# factors of joints and distance with which these errors hold: a network's landmarks are off alike
# over whole clips, which the fit takes for noise (benchmarks/real.py, end_to_end.py)
ALIKE = (2.0, 1.6)


def body_errors(problem: FitProblem, unknowns: Unknowns, spread: float) -> BodyErrors:
    """By draws from the normal distribution about the most probable body (Laplace 1774).

    The size of the body, which the fit takes for all but known, is drawn beside it: a larger body
    that is farther off by as much is seen alike. The scale of the cameras' world is not.

    Where the fit's equations do not say how far each number may be off, the errors are NaN.

    Args:
        spread: standard deviation of the logarithm of the body's size.
    """
    frames = len(unknowns.pose.transl)
    equations = NormalEquations(frames, PER_FRAME, problem.count_shared(unknowns))
    problem.energy(unknowns, 1.0, equations)
    generator = torch.Generator().manual_seed(0)
    best, seen = problem.joints(unknowns), _seen(problem)
    joints, distances = [], []
    try:
        for own, shared in equations.draws(DRAWS, generator):
            shared[-1:] = 0  # the scale: one that nothing shows would be drawn from everywhere
            size = math.exp(spread * float(torch.randn((), generator=generator)))
            at = size * problem.joints(unknowns.moved(own, shared))
            distances.append((at - best)[:, SHOULDERS, 2].mean(1).abs())
            off = (_about_shoulders(at) - _about_shoulders(best)).norm(dim=-1)
            joints.append((off * seen).sum(1) / seen.sum(1))
    except (np.linalg.LinAlgError, torch.linalg.LinAlgError):  # not positive definite
        return BodyErrors.unknown(frames)
    within = (torch.stack(found).quantile(SHARE, 0).float() for found in (joints, distances))
    return BodyErrors(*(factor * errors for factor, errors in zip(ALIKE, within, strict=True)))


def _seen(problem: FitProblem) -> Float[Tensor, "F 22"]:
    """1 for the joints that are seen; for all that have landmarks, where none is."""
    seen = torch.zeros(len(problem.visible), JOINTS, dtype=torch.float64)
    marks = [problem.points.index(mark) for mark in JOINT_OF]
    shown = (problem.visible[:, marks] > VISIBLE).double()
    shown[shown.sum(1) == 0] = 1
    seen[:, list(JOINT_OF.values())] = shown
    return seen


def _about_shoulders(joints: Float[Tensor, "F J 3"]) -> Float[Tensor, "F J 3"]:
    return joints - joints[:, SHOULDERS].mean(1, keepdim=True)
