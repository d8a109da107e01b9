"""How far a fitted body may be off from the truth, by what the fit leaves open."""

from __future__ import annotations

import math
from copy import copy

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.preparation.body.fit_problem import SPACE_LASTS as BELIEVED
from hoigs.preparation.body.fit_problem import FitProblem, Unknowns
from hoigs.preparation.body.fitted import BodyErrors
from hoigs.preparation.body.kinematics import JOINTS, PER_FRAME, NormalEquations
from hoigs.preparation.body.landmarks import JOINTS as JOINT_OF

DRAWS = 48
SHOULDERS = [16, 17]  # body joints
VISIBLE = 0.5
SHARE = 0.8  # of the frames, in which the body is to be within its errors
# The errors of a network's landmarks last longer than the fit supposes, in space for seconds and in
# the image for one or two, and the fit follows them: in the image they are about this many times
# what it leaves over. So they are on three real cameras and four drawn clips, where landmarks are
# two to four times as far off as on the real ones; by these three, what is said holds on both
# (benchmarks/real.py, end_to_end.py).
IMAGE_LASTS, SPACE_LASTS = 1.5, 3.0  # seconds
FOLLOWED = 5.0


def body_errors(problem: FitProblem, unknowns: Unknowns, spread: float) -> BodyErrors:
    """By draws from the normal distribution about the most probable body (Laplace 1774), with
    landmarks as uncertain as errors that last make them.

    The size of the body, which the fit takes for all but known, is drawn beside it: a larger body
    that is farther off by as much is seen alike. The scale of the cameras' world is not.

    Where the fit's equations do not say how far each number may be off, the errors are NaN.

    Args:
        spread: standard deviation of the logarithm of the body's size.
    """
    frames = len(unknowns.pose.transl)
    equations = NormalEquations(frames, PER_FRAME, problem.count_shared(unknowns))
    _lasting(problem, unknowns).energy(unknowns, 1.0, equations)
    generator = torch.Generator().manual_seed(0)
    best, seen = problem.joints(unknowns), _seen(problem)
    joints, distances = [], []
    # sizes by quantiles: they are the same in all frames, and some drawn by chance may be lopsided
    sizes = torch.special.ndtri((torch.randperm(DRAWS, generator=generator) + 0.5) / DRAWS)
    try:
        draws = equations.draws(DRAWS, generator)
        for (own, shared), larger in zip(draws, sizes.tolist(), strict=True):
            shared[-1:] = 0  # the scale: one that nothing shows would be drawn from everywhere
            at = math.exp(spread * larger) * problem.joints(unknowns.moved(own, shared))
            distances.append((at - best)[:, SHOULDERS, 2].mean(1).abs())
            off = (_about_shoulders(at) - _about_shoulders(best)).norm(dim=-1)
            joints.append((off * seen).sum(1) / seen.sum(1))
    except (np.linalg.LinAlgError, torch.linalg.LinAlgError):  # not positive definite
        return BodyErrors.unknown(frames)
    return BodyErrors(
        *(torch.stack(found).quantile(SHARE, 0).float() for found in (joints, distances))
    )


def _lasting(problem: FitProblem, unknowns: Unknowns) -> FitProblem:
    """The same problem with landmarks that weigh no more than their errors, which last, allow."""
    left = float(problem.misses(unknowns).nanmean())
    spread = max(1.0, FOLLOWED * left / problem.noise)  # in parts of that which the fit supposes
    found, whole = copy(problem), float(problem.spacing.sum())

    def share(lasts: float) -> Float[Tensor, "F 1"]:
        """Of evidence of its own in each frame; a short clip is one piece of it."""
        return (problem.spacing / min(lasts, whole)).clamp_max(1.0)[:, None]

    found.visible = problem.visible * share(IMAGE_LASTS) / spread**2
    believed = (problem.spacing / BELIEVED).clamp_max(1.0)[:, None]
    found.in_space = problem.in_space * share(SPACE_LASTS) / believed
    return found


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
