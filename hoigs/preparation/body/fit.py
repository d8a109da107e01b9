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
from hoigs.preparation.body.fit_problem import BodyFit, FitOptions, FitProblem, Unknowns
from hoigs.preparation.body.landmarks import (
    ENOUGH,
    LandmarkTrack,
)
from hoigs.preparation.body.mask_fit import MaskFit


def fit_body(
    body: BodyModel,
    landmarks: LandmarkTrack,
    cameras: Sequence[Camera],
    *,
    options: FitOptions | None = None,
    points: Float[Tensor, "S 3"] | None = None,
    masks: Iterable[Bool[np.ndarray, "H W"]] | None = None,
    progress: Callable[[float], None] | None = None,
) -> BodyFit:
    """Pose, shape and place of a body in every frame, in metres.

    Minimises, over all frames at once: robust reprojection of the landmarks, weighted by their
    visibility; directions of bones against the 3D landmarks, where there are any; joint limits;
    acceleration in the world; a shape estimator; departures from the start. Frames with fewer than
    `landmarks.ENOUGH` landmarks are carried by smoothness and, where there are any, masks.

    With `options.scale` the cameras' translations are multiplied by one unknown number: the body
    is metric, and so becomes the world. It comes from the scene's points on the ground at the feet,
    or, without them, from feet that stand still and from smoothness (poor if the person walks).

    Args:
        points: of the scene, in the cameras' own unit; only used to find the scale.
        masks: one a frame, of the person or of all that moves.
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
    problem = FitProblem(body, landmarks, cameras, options)
    if options.scale and points is not None:
        problem.ground = points
    if masks is not None and options.masks and not seen.all():
        unseen = {i: mask for i, mask in enumerate(masks) if not seen[i]}
        problem.masks = MaskFit(body, unseen, options.mask_spread)
    pairs = int(problem.points.pairs.max()) + 1
    unknowns = Unknowns(problem.start, body.num_betas, pairs, options.scale)
    solve(problem, unknowns, options, progress)
    with torch.no_grad():
        return problem.result(unknowns)


def solve(
    problem: FitProblem,
    unknowns: Unknowns,
    options: FitOptions,
    progress: Callable[[float], None] | None,
) -> None:
    """Adam with a rate that falls to a hundredth."""
    groups = [
        {"params": [unknowns.body, unknowns.global_orient], "lr": options.rate},
        {"params": [unknowns.transl], "lr": options.rate},
        {"params": [unknowns.betas], "lr": options.rate},
        {"params": [unknowns.offsets], "lr": 0.1 * options.rate},
    ]
    if options.scale:
        groups.append({"params": [unknowns.log_scale], "lr": 0.1 * options.rate})
    adam = torch.optim.Adam(groups)
    decay = torch.optim.lr_scheduler.ExponentialLR(adam, 0.01 ** (1 / options.steps))
    for step in range(options.steps):
        if step in (options.steps // 3, 2 * options.steps // 3):
            problem.rescale(unknowns)
        problem.carry(unknowns, step / options.steps)
        adam.zero_grad()
        # the robust spread narrows, so that a poor start is not taken for outliers
        widen = 1 + 4 * max(0.0, 1 - 2 * step / options.steps)
        problem.energy(unknowns, widen).backward()
        adam.step()
        decay.step()
        if progress is not None:
            progress((step + 1) / options.steps)
