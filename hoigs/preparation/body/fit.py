"""Fitting a body to landmarks over a whole clip at once: pose, shape, place and world scale."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.body import BodyModel
from hoigs.core.values.camera import Camera
from hoigs.preparation.body.fit_problem import FitProblem
from hoigs.preparation.body.fit_values import BodyFit, FitOptions, Unknowns
from hoigs.preparation.body.kinematics import PER_FRAME
from hoigs.preparation.body.landmarks import (
    ENOUGH,
    LandmarkTrack,
)
from hoigs.preparation.body.mask_fit import MaskFit
from hoigs.preparation.body.normal_equations import NormalEquations

DAMPING, STUCK = 1e-3, 1e4
ESTIMATED = (6, 9, 12)  # steps before which the landmarks' noise is estimated anew
RESCALED = (4, 8, 11)
SETTLED = 14  # steps after which nothing but convergence is left to wait for
ENOUGH_GAIN = 1e-3  # of the energy, below which a step is the last


def fit_body(
    body: BodyModel,
    landmarks: LandmarkTrack,
    cameras: Sequence[Camera],
    *,
    options: FitOptions | None = None,
    points: Float[Tensor, "S 3"] | None = None,
    masks: Iterable[Bool[np.ndarray, "H W"]] | None = None,
    times: Float[Tensor, " F"] | None = None,
    turns: Float[Tensor, "F 21 3"] | None = None,
    progress: Callable[[float], None] | None = None,
) -> BodyFit:
    """Pose, shape and place of a body in every frame, in metres.

    The most probable body, over all frames at once: robust reprojection of the landmarks, weighted
    by their visibility, and directions of bones against the 3D landmarks, where there are any,
    each by its noise, which is estimated; joint limits and rest; accelerations in the world, in
    m/s^2, with the long tails that throws have; shape. Frames with fewer than `landmarks.ENOUGH`
    landmarks are carried by smoothness and, where there are any, masks.

    With `options.scale` the cameras' translations are multiplied by one unknown number: the body
    is metric, and so becomes the world. It comes from the scene's points on the ground at the feet,
    or, without them, from feet that stand still and from smoothness (poor if the person walks).

    Args:
        points: of the scene, in the cameras' own unit; only used to find the scale.
        masks: one a frame, of the person or of all that moves.
        times: of the frames, seconds; by default 30 frames a second.
        turns: axis-angle of joints 1..21 as another program has found them: the fit starts there,
            and `PosePrior` holds it near.
        progress: called with 0..1.

    Raises:
        HoigsError: cameras and landmarks differ in number, or there are hardly any landmarks.
    """
    options = options or FitOptions()
    seen = landmarks.found
    if len(cameras) != len(seen):
        raise HoigsError(f"{len(cameras)} cameras but landmarks of {len(seen)} frames")
    if int(seen.sum()) < 2:
        raise HoigsError(
            f"{ENOUGH} landmarks or more were found in {int(seen.sum())} of {len(seen)} frames; a "
            "body fit needs at least 2: is the person in view?"
        )
    times = torch.arange(len(seen)) / 30.0 if times is None else times
    problem = FitProblem(body, landmarks, cameras, times, options, turns)
    if options.scale and points is not None:
        problem.ground = points
    if masks is not None and options.masks and not seen.all():
        unseen = {i: mask for i, mask in enumerate(masks) if not seen[i]}
        problem.masks = MaskFit(body, unseen, options.mask_spread, options.masks)
    with torch.no_grad():
        return problem.result(solve(problem, options.steps, progress))


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
    frames, shared = len(unknowns.pose.transl), unknowns.pose.betas.numel()
    shared += unknowns.offsets.numel() + 2
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
