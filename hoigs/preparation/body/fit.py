"""Fitting a body to landmarks over a whole clip at once: pose, shape, place and world scale."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Int
from torch import Tensor

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.body import BodyModel
from hoigs.core.maths.frame_times import Chunking
from hoigs.core.values.moment import BodyPose
from hoigs.preparation.body.errors import body_errors
from hoigs.preparation.body.fit_problem import (
    FitOptions,
    FitProblem,
    Found,
    Observations,
    Unknowns,
)
from hoigs.preparation.body.fitted import BodyErrors, BodyFit, Joint
from hoigs.preparation.body.girths import girths
from hoigs.preparation.body.kinematics import PER_FRAME, REACH, NormalEquations, nearest_turn
from hoigs.preparation.body.landmarks import ENOUGH
from hoigs.preparation.body.mask_fit import Masks
from hoigs.preparation.body.start import first_guess

# Gauss-Newton on the energy of the body fit.

DAMPING, STUCK = 1e-3, 1e4
ESTIMATED = (6, 9, 12)  # steps before which ordinary motion is estimated anew
RESCALED = (4, 8, 11)
SETTLED = 14  # steps after which nothing but convergence is left to wait for
ENOUGH_GAIN = 1e-3  # of the energy, below which a step is the last
MASKS, AFTER = 24, 2  # frames whose masks show the girths, at most; steps after that


def solve(problem: FitProblem, steps: int, progress: Callable[[float], None] | None) -> Unknowns:
    """Gauss-Newton with Marquardt's damping, until steps change next to nothing."""
    unknowns, damping = problem.begin, DAMPING
    for step in range(steps):
        # the robust spread narrows, so that a poor start is not taken for outliers
        widen = max(1.0, 5.0 - step)
        if step in RESCALED:
            unknowns = problem.rescale(unknowns)
            problem.measure(unknowns)
        if step in ESTIMATED:
            problem.estimate_motion(unknowns)
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


def with_girths(
    problem: FitProblem, unknowns: Unknowns, masks: Masks, frames: Int[Tensor, " S"]
) -> Unknowns:
    """A solved problem solved on, with the body's girths by its masks.

    Args:
        masks: of the clip. frames: of it, those of the problem.
    """
    rows = problem.seen.nonzero()[:, 0]
    rows = rows[torch.linspace(0, len(rows) - 1, MASKS).round().long()].unique()
    shown = {int(row): masks[int(frames[row])] for row in rows}
    cameras = [camera.scaled(unknowns.scale) for camera in problem.cameras]
    betas = girths(problem.body, unknowns.pose, cameras, shown)
    problem.shape = betas - unknowns.pose.betas
    unknowns = replace(unknowns, pose=unknowns.pose.replace(betas=betas))
    damping = DAMPING
    for _ in range(AFTER):
        unknowns, damping, gain = _improved(problem, unknowns, 1.0, damping)
        if gain < ENOUGH_GAIN:
            break
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


# The body fit of a long clip, window by window: one shape, and poses that follow on.

STRETCHES, SHORTEST = 10, 8  # in which frames that stand for all are taken; frames of one, at least
STAND_FOR_ALL = 2  # windows that have as many frames as stand for all


def fit_in_windows(
    body: BodyModel,
    seen: Observations,
    options: FitOptions,
    chunking: Chunking,
    progress: Callable[[float], None] | None,
) -> BodyFit:
    """As `fit_body`, with memory for two windows.

    What all frames share (shape, places of the landmarks, noise, ordinary motion, the world's
    scale) is fitted to as many frames as two windows have, in stretches from all over the clip,
    and then kept. Each window keeps the first poses of its overlap as the window before has found
    them, so that accelerations are priced across the joint, and replaces the later ones, of which
    that had not seen what follows (a fixed-lag smoother).
    """
    landmarks = seen.landmarks
    windows = chunking.windows(len(seen.cameras))
    share = partial(_share, progress, len(windows) + 1)
    rows = spread(landmarks.found.nonzero()[:, 0], STAND_FOR_ALL * chunking.chunk)
    known = FitProblem(body, seen.rows(rows), options)
    if seen.points is not None:
        known.ground = seen.points
    shared = solve(known, options.steps, partial(share, 0))
    if seen.masks is not None:
        shared = with_girths(known, shared, seen.masks, rows)
    found = Found(
        known.noise, known.motion.ordinary, shared.pose.betas, shared.offsets, shared.unit
    )
    metric = replace(options, scale=False)
    scaled = replace(seen, cameras=[c.scaled(shared.scale) for c in seen.cameras])
    start = first_guess(body, landmarks, scaled.cameras, False)
    parts: list[BodyPose] = []
    misses: list[Tensor] = []
    errors: list[BodyErrors] = []
    joints: list[Joint] = []
    before: BodyPose | None = None  # of the next window's first own frame, by the last one
    for number, window in enumerate(windows):
        problem = FitProblem(body, scaled.rows(window), metric, start.part(window), found)
        if seen.masks is not None:
            problem.show(seen.masks, window.start)
        solved = solve(problem, options.steps, partial(share, number + 1))
        own, last = found.frames, window == windows[-1]
        if before is not None:
            after = solved.pose.frame(slice(own, own + 1))
            joints.append(_joint(problem, before, after, window.start + own))
        length = window.stop - window.start
        stop = length if last else windows[number + 1].start - window.start + REACH
        parts.append(solved.pose.frame(slice(own, stop)))
        misses.append(problem.misses(solved)[own:stop])
        errors.append(body_errors(problem, solved, known.size.spread).rows(slice(own, stop)))
        if not last:
            found = replace(found, pose=solved.pose.frame(slice(stop - REACH, stop)))
            before = solved.pose.frame(slice(stop, stop + 1))
    whole = Unknowns(_joined(parts), shared.offsets, shared.unit, shared.scale)
    result = known.result(whole, torch.cat(misses), BodyErrors.joined(errors))
    counts = {
        "frames_with_landmarks": int(landmarks.found.sum()),
        "frames_with_landmarks_in_space": int(landmarks.solid.sum()),
        "windows": len(windows),
        "frames_that_gave_the_shape": len(rows),
        "joints": [[j.frame, round(j.metres, 5), round(j.degrees, 3)] for j in joints],
    }
    return replace(result, report=result.report | counts, joints=tuple(joints))


def spread(frames: Int[Tensor, " S"], count: int) -> Int[Tensor, " T"]:
    """At most `count` of these frames, in stretches from all over them."""
    stretches = max(1, min(STRETCHES, count // SHORTEST))
    parts = frames.tensor_split(stretches)
    length = count // stretches
    middles = [max(0, (len(part) - length) // 2) for part in parts]
    return torch.cat([p[m : m + length] for p, m in zip(parts, middles, strict=True)])


def _joint(problem: FitProblem, before: BodyPose, after: BodyPose, frame: int) -> Joint:
    """Of two poses of one frame."""
    (a, b), (p, q) = zip(*map(problem.kinematics.placed, (before, after)), strict=True)
    angle = ((a.mT @ b).diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    degrees = math.degrees(float(angle.clamp(-1, 1).acos().max()))
    return Joint(frame, float((p - q).norm(dim=-1).max()), degrees)


def _joined(parts: Sequence[BodyPose]) -> BodyPose:
    names = ("global_orient", "body", "left_hand", "right_hand", "transl")
    fields = {name: torch.cat([getattr(part, name) for part in parts]) for name in names}
    fields["global_orient"] = nearest_turn(fields["global_orient"])
    return parts[0].replace(**fields)


def _share(progress: Callable[[float], None] | None, count: int, number: int, done: float) -> None:
    """The progress of one of several equal works."""
    if progress is not None:
        progress((number + done) / count)


def fit_body(
    body: BodyModel,
    seen: Observations,
    options: FitOptions | None = None,
    chunking: Chunking | None = None,
    progress: Callable[[float], None] | None = None,
) -> BodyFit:
    """Pose, shape and place of a body in every frame, in metres.

    The most probable body, over all frames at once: robust reprojection of the landmarks, weighted
    by their visibility, and directions of bones against the 3D landmarks, where there are any,
    each by how far such landmarks are off; joint limits and rest; accelerations in the world, in
    m/s^2, with the long tails that throws have; shape. Frames with fewer than `landmarks.ENOUGH`
    landmarks are carried by smoothness and, where there are any, masks.

    With `options.scale` the cameras' translations are multiplied by one unknown number: the body
    is metric, and so becomes the world. It comes from the scene's points on the ground at the feet,
    or, without them, from feet that stand still and from smoothness (poor if the person walks).

    Args:
        chunking: fit window by window (`fit_in_windows`); None: all frames at once.
        progress: called with 0..1.

    Raises:
        HoigsError: cameras and landmarks differ in number, or there are hardly any landmarks.
    """
    options = options or FitOptions()
    found, cameras = seen.landmarks.found, seen.cameras
    if len(cameras) != len(found):
        raise HoigsError(f"{len(cameras)} cameras but landmarks of {len(found)} frames")
    if int(found.sum()) < 2:
        raise HoigsError(
            f"{ENOUGH} landmarks or more were found in {int(found.sum())} of {len(found)} frames; "
            "a body fit needs at least 2: is the person in view?"
        )
    seen = replace(
        seen,
        landmarks=seen.landmarks.in_cameras(torch.stack([c.K for c in cameras])),
        points=seen.points if options.scale else None,
    )
    with torch.no_grad():
        if chunking is not None and len(chunking.windows(len(found))) > 1:
            return fit_in_windows(body, seen, options, chunking, progress)
        problem = FitProblem(body, seen, options)
        if seen.points is not None:
            problem.ground = seen.points
        if seen.masks is not None:
            problem.show(seen.masks)
        unknowns = solve(problem, options.steps, progress)
        if seen.masks is not None:
            unknowns = with_girths(problem, unknowns, seen.masks, torch.arange(len(found)))
        errors = body_errors(problem, unknowns, problem.size.spread)
        return problem.result(unknowns, problem.misses(unknowns), errors)
