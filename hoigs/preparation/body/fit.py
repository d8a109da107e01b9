"""Fitting a body to landmarks over a whole clip at once: pose, shape, place and world scale."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.body import BodyModel
from hoigs.core.values.camera import Camera
from hoigs.core.windows import Chunking
from hoigs.preparation.body.fit_problem import FitProblem
from hoigs.preparation.body.fit_values import BodyFit, FitOptions
from hoigs.preparation.body.gauss_newton import solve
from hoigs.preparation.body.landmarks import ENOUGH, LandmarkTrack
from hoigs.preparation.body.mask_fit import Masks
from hoigs.preparation.body.windowed_fit import fit_in_windows


def fit_body(
    body: BodyModel,
    landmarks: LandmarkTrack,
    cameras: Sequence[Camera],
    *,
    options: FitOptions | None = None,
    points: Float[Tensor, "S 3"] | None = None,
    masks: Masks | None = None,
    times: Float[Tensor, " F"] | None = None,
    turns: Float[Tensor, "F 21 3"] | None = None,
    chunking: Chunking | None = None,
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
        chunking: fit window by window (`fit_in_windows`); None: all frames at once.
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
    if not options.scale:
        points = None
    with torch.no_grad():
        if chunking is not None and len(chunking.windows(len(seen))) > 1:
            return fit_in_windows(
                body, landmarks, cameras, times, options, points, masks, turns, chunking, progress
            )
        problem = FitProblem(body, landmarks, cameras, times, options, turns)
        if points is not None:
            problem.ground = points
        if masks is not None:
            problem.show(masks)
        unknowns = solve(problem, options.steps, progress)
        return problem.result(unknowns, problem.misses(unknowns))
