"""The body fit of a long clip, window by window: one shape, and poses that follow on."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hoigs.core.interfaces.body import BodyModel
from hoigs.core.values.camera import Camera
from hoigs.core.values.moment import BodyPose
from hoigs.core.windows import Chunking
from hoigs.preparation.body.fit_problem import FitProblem
from hoigs.preparation.body.fit_values import BodyFit, FitOptions, Found, Joint, Unknowns
from hoigs.preparation.body.gauss_newton import solve
from hoigs.preparation.body.kinematics import nearest_turn
from hoigs.preparation.body.landmarks import LandmarkTrack
from hoigs.preparation.body.mask_fit import Masks
from hoigs.preparation.body.normal_equations import REACH
from hoigs.preparation.body.start.torso import first_guess

STRETCHES, SHORTEST = 10, 8  # in which frames that stand for all are taken; frames of one, at least


def fit_in_windows(
    body: BodyModel,
    landmarks: LandmarkTrack,
    cameras: Sequence[Camera],
    times: Float[Tensor, " F"],
    options: FitOptions,
    points: Float[Tensor, "S 3"] | None,
    masks: Masks | None,
    turns: Float[Tensor, "F 21 3"] | None,
    chunking: Chunking,
    progress: Callable[[float], None] | None,
) -> BodyFit:
    """As `fit_body`, with memory for one window.

    What all frames share (shape, places of the landmarks, noise, ordinary motion, the world's
    scale) is fitted to as many frames as a window has, in stretches from all over the clip, and
    then kept. Each window keeps the first poses of its overlap as the window before has found them,
    so that accelerations are priced across the joint, and replaces the later ones, of which that
    had not seen what follows (a fixed-lag smoother).
    """
    windows = chunking.windows(len(cameras))
    share = partial(_share, progress, len(windows) + 1)
    rows = spread(landmarks.found.nonzero()[:, 0], chunking.chunk)
    some = landmarks.rows(rows)
    known = FitProblem(
        body, some, [cameras[i] for i in rows.tolist()], times[rows], options,
        None if turns is None else turns[rows],
    )  # fmt: skip
    if points is not None:
        known.ground = points
    shared = solve(known, options.steps, partial(share, 0))
    found = Found(
        known.noise, known.motion.ordinary, shared.pose.betas, shared.offsets, shared.unit
    )
    metric, cameras = replace(options, scale=False), [c.scaled(shared.scale) for c in cameras]
    start = first_guess(body, landmarks, cameras, False)
    parts: list[BodyPose] = []
    misses: list[Tensor] = []
    joints: list[Joint] = []
    before: BodyPose | None = None  # of the next window's first own frame, by the last one
    for number, window in enumerate(windows):
        problem = FitProblem(
            body, landmarks.rows(window), cameras[window], times[window], metric,
            None if turns is None else turns[window], start.part(window), found,
        )  # fmt: skip
        if masks is not None:
            problem.show(masks, window.start)
        solved = solve(problem, options.steps, partial(share, number + 1))
        own, last = found.frames, window == windows[-1]
        if before is not None:
            after = solved.pose.frame(slice(own, own + 1))
            joints.append(_joint(problem, before, after, window.start + own))
        length = window.stop - window.start
        stop = length if last else windows[number + 1].start - window.start + REACH
        parts.append(solved.pose.frame(slice(own, stop)))
        misses.append(problem.misses(solved)[own:stop])
        if not last:
            found = replace(found, pose=solved.pose.frame(slice(stop - REACH, stop)))
            before = solved.pose.frame(slice(stop, stop + 1))
    whole = Unknowns(_joined(parts), shared.offsets, shared.unit, shared.scale)
    result = known.result(whole, torch.cat(misses))
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
