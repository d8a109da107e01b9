"""Body poses and cameras of scored frames: given, interpolated, blended or fitted."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.maths.splines import neighbours
from hoigs.core.model.scene import SceneModel
from hoigs.core.progress import Progress, no_progress
from hoigs.core.spec.train_schema import TestCamera, TestPose, TestPoseSetting
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import POSES_ESTIMATED, Clip, Frame
from hoigs.core.values.moment import BodyPose, Moment
from hoigs.evaluation.blending import blended, own_share
from hoigs.evaluation.interpolation import camera_between, pose_between
from hoigs.metrics.image_loss import image_loss

FIT_STEPS = 40
FIT_RATES = (5e-3, 2e-3)  # initial learning rates, radians and metres: body poses, cameras
FIT_DSSIM = 0.2  # weight of D-SSIM in the image loss


def source_of_poses(clip: Clip, setting: TestPoseSetting) -> TestPose:
    """What "auto" stands for: poses that were estimated are trusted as far as training frames bear
    out."""
    if setting != "auto":
        return setting
    return "blended" if clip.provenance.get(POSES_ESTIMATED) else "given"


def posed_clip(
    model: SceneModel,
    clip: Clip,
    *,
    split: str = "test",
    test_pose: TestPose = "given",
    test_camera: TestCamera = "given",
    fit_steps: int = FIT_STEPS,
    share: float | None = None,
    progress: Progress | None = None,
) -> Clip:
    """The clip with the poses and cameras of a protocol for the frames of a split.

    "given" changes nothing. "interpolated" takes them from the two neighbouring training frames,
    rotations by SLERP, positions linearly; the model then adds its learned corrections, which it
    interpolates likewise. "blended" goes from these poses a share of the way to the frame's own;
    `share` is it, or None to find it in training frames (`blending.own_share`). "fitted" optimises
    them on the *image that is scored*, with the model frozen, starting from the given ones.
    Training frames and intrinsics never change.

    Views of `clip.held_out` take the body poses of their moments; their cameras stay, and nothing
    is fitted to their images.

    Raises:
        ValueError: there is no training frame to interpolate from.
    """
    report = progress or no_progress
    trained = sorted(clip.split.get("train", ()), key=lambda p: clip.moments[p].time)
    chosen = [p for p in clip.split[split] if p not in set(trained)]
    if {"interpolated", "blended"} & {test_pose, test_camera} and chosen:
        if not trained:
            raise ValueError("nothing to interpolate from: the clip has no training frames")
        if test_pose == "blended":
            share = own_share(model, clip, split, report) if share is None else share
            clip = _blended(model, clip, chosen, share)
        clip = _interpolated(clip, trained, chosen, test_pose, test_camera)
    if "fitted" in (test_pose, test_camera):
        moments, cameras = list(clip.moments), list(clip.cameras)
        for done, p in enumerate(chosen):
            fit = fit_frame(
                model, clip[p], test_pose == "fitted", test_camera == "fitted", fit_steps
            )
            moments[p], cameras[p] = fit.moment, fit.camera
            report((done + 1) / len(chosen), "fitting poses to test images")
        clip = replace(clip, moments=moments, cameras=cameras)
    if clip.held_out is None or test_pose == "given":
        return clip
    changed = {clip.moments[p].index: clip.moments[p] for p in chosen}
    views = [changed.get(m.index, m) for m in clip.held_out.moments]
    return replace(clip, held_out=replace(clip.held_out, moments=views))


def _blended(model: SceneModel, clip: Clip, chosen: list[int], share: float) -> Clip:
    moments = list(clip.moments)
    for p in chosen:
        moments[p] = blended(model, clip, p, share)
    return replace(clip, moments=moments)


def _interpolated(
    clip: Clip, trained: list[int], chosen: list[int], pose: TestPose, camera: TestCamera
) -> Clip:
    times = [clip.moments[p].time for p in trained]
    moments, cameras = list(clip.moments), list(clip.cameras)
    for p in chosen:
        low, high, r = neighbours(clip.moments[p].time, times)
        a, b = trained[low], trained[high]
        if pose == "interpolated":
            before, after = clip.moments[a].poses, clip.moments[b].poses
            between = {n: pose_between(before[n], after[n], r) for n in clip.moments[p].poses}
            moments[p] = replace(clip.moments[p], poses=between)
        if camera == "interpolated":
            viewmat = camera_between(clip.cameras[a], clip.cameras[b], r).world_to_camera
            cameras[p] = replace(clip.cameras[p], world_to_camera=viewmat)
    return replace(clip, moments=moments, cameras=cameras)


@dataclass(frozen=True)
class FrameFit:
    """A frame whose body poses or camera were optimised on its image.

    Attributes:
        loss: at the start, and at the best step, which `moment` and `camera` are from.
    """

    moment: Moment
    camera: Camera
    loss: tuple[float, float]


def fit_frame(
    model: SceneModel, frame: Frame, poses: bool, camera: bool, steps: int = FIT_STEPS
) -> FrameFit:
    """Optimise body poses, the camera or both on one frame's image, with the model frozen.

    Minimises 0.8 L1 + 0.2 (1 - SSIM) of the whole image by Adam with a cosine schedule, and keeps
    the best step. ExAvatar fits its test frames in this way (mks0601/ExAvatar_RELEASE#51: 36 dB
    with the fit, 31 dB without).

    Args:
        poses: whether to fit those of all modelled humans. camera: whether to fit its rotation and
            translation.
    """
    device = model.device
    names = [n for n in frame.moment.poses if n in model.entities] if poses else []
    turns = {n: torch.zeros(52, 3, device=device, requires_grad=True) for n in names}
    shifts = {n: torch.zeros(3, device=device, requires_grad=True) for n in names}
    view = [torch.zeros(3, device=device, requires_grad=True) for _ in range(2 if camera else 0)]
    groups = [
        {"params": group, "lr": rate}
        for group, rate in zip(([*turns.values(), *shifts.values()], view), FIT_RATES)
        if group
    ]
    if not groups:
        return FrameFit(frame.moment, frame.camera, (math.nan, math.nan))
    given, start = frame.moment.to(device), frame.camera.to(device)
    target = frame.rgb.to(device)
    hidden = None if frame.ignored is None else frame.ignored.to(device)[..., None]

    def current() -> tuple[Moment, Camera]:
        moment = given
        for n in names:
            moment = moment.with_pose(n, _moved(given.poses[n], turns[n], shifts[n]))
        return moment, start.moved(*view) if camera else start

    def detached() -> tuple[Moment, Camera]:
        moment, seen_from = current()
        return (
            replace(moment, poses={n: p.map(torch.detach) for n, p in moment.poses.items()}),
            replace(seen_from, world_to_camera=seen_from.world_to_camera.detach()),
        )

    adam = torch.optim.Adam(groups)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(adam, steps)
    losses: list[float] = []
    best = detached()
    with _frozen(model):
        for step in range(steps + 1):  # the last iteration only evaluates the last update
            color = model.render(*current()).color
            if hidden is not None:
                color = torch.where(hidden, target, color)
            loss = image_loss(color, target, FIT_DSSIM)
            if not losses or float(loss.detach()) < min(losses):
                best = detached()
            losses.append(float(loss.detach()))
            if step == steps or not loss.requires_grad:
                break
            adam.zero_grad()
            loss.backward()
            adam.step()
            schedule.step()
    return FrameFit(best[0].to("cpu"), best[1].to("cpu"), (losses[0], min(losses)))


def _moved(pose: BodyPose, turn: Float[Tensor, "52 3"], shift: Float[Tensor, " 3"]) -> BodyPose:
    return pose.with_residual(turn[1:]).replace(
        global_orient=pose.global_orient + turn[0], transl=pose.transl + shift
    )


@contextmanager
def _frozen(model: SceneModel) -> Iterator[None]:
    """Inside, gradients are enabled, but the model's parameters take none."""
    trained = [p for p in model.parameters() if p.requires_grad]
    model.requires_grad_(False)
    try:
        with torch.enable_grad():
            yield
    finally:
        for parameter in trained:
            parameter.requires_grad_(True)
