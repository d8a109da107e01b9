"""Body poses and cameras of scored frames: given, interpolated, blended or fitted."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.interfaces.deformation import ProvidesSkeleton
from hoigs.core.maths.rotations import (
    axis_angle_to_quats,
    multiply_quats,
    quats_to_axis_angle,
    turn_between,
)
from hoigs.core.maths.splines import neighbours
from hoigs.core.model.scene import SceneModel
from hoigs.core.reporting import Progress, no_progress
from hoigs.core.spec.train_schema import TestCamera, TestPose, TestPoseSetting
from hoigs.core.values.between import blend_cameras, blend_poses
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import POSES_ESTIMATED, Clip, Frame
from hoigs.core.values.moment import BodyPose, Moment
from hoigs.evaluation.options import ScoreOptions
from hoigs.metrics.image_loss import image_loss
from hoigs.metrics.psnr import region_psnr

# Body poses and cameras between two others.


def pose_between(a: BodyPose, b: BodyPose, r: float) -> BodyPose:
    """`blend_poses`, with the axis-angles that are nearer to those of `a`; r in [0, 1]."""
    between = blend_poses(a, b, r)
    return with_rotations(between, nearest_axis_angle(between.rotations, a.rotations))


def with_rotations(pose: BodyPose, rotations: Float[Tensor, "52 3"]) -> BodyPose:
    """`pose` with other axis-angles, ordered as `BodyPose.rotations`."""
    return pose.replace(
        global_orient=rotations[0],
        body=rotations[1:22],
        left_hand=rotations[22:37],
        right_hand=rotations[37:],
    )


def nearest_axis_angle(
    vectors: Float[Tensor, "J 3"], reference: Float[Tensor, "J 3"]
) -> Float[Tensor, "J 3"]:
    """Of the two axis-angles of each rotation (below and above pi) the one nearer to `reference`.

    Corrections that are added to axis-angles were learned for the neighbours' vector; near half a
    turn they would act in the opposite direction on the other one.
    """
    angle = vectors.norm(dim=-1, keepdim=True)
    other = vectors - 2 * math.pi * vectors / angle.clamp_min(1e-6)
    nearer = (other - reference).norm(dim=-1) < (vectors - reference).norm(dim=-1)
    return torch.where(nearer[:, None] & (angle > 1e-3), other, vectors)


def camera_between(a: Camera, b: Camera, r: float) -> Camera:
    """`blend_cameras` with the intrinsics of `a`; r in [0, 1]."""
    return replace(a, world_to_camera=blend_cameras(a, b, r).world_to_camera)


# Body poses of test frames between their neighbours' and their own, by a share found in training
# frames.
#
# A pose between two neighbours is steady, but misses what happened in between; the estimate of the
# frame itself has that, and its own error. Which of them is the better differs from clip to clip.
# Training frames tell: each is posed as if it were not trained on, and drawn.

SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
FRAMES = 16  # training frames that are drawn with each share, at most


@torch.no_grad()
def own_share(
    model: SceneModel, clip: Clip, split: str = "test", progress: Progress = no_progress
) -> float:
    """The share of `SHARES` that draws training frames best (mean PSNR of whole images) when each
    is posed by `blended`; 0 where none lies between two others.

    Only frames are drawn whose neighbours are no farther apart than those of the split's frames,
    or the closest ones: over a longer time, poses in between are worse, and the share larger.
    """
    frames = _like(clip, split)
    scores = []
    for i, share in enumerate(SHARES if frames else ()):
        moments = [blended(model, clip, p, share) for p in frames]
        drawn = [_psnr(model, clip, p, m) for p, m in zip(frames, moments, strict=True)]
        scores.append(float(np.mean(drawn)))
        progress((i + 1) / len(SHARES), "finding how far estimated poses may be trusted")
    return SHARES[int(np.argmax(scores))] if scores else 0.0


@torch.no_grad()
def blended(model: SceneModel, clip: Clip, position: int, share: float) -> Moment:
    """A frame's moment, each body pose that of the training frames around, moved by a share of
    what its own pose differs from its neighbours'.

    That difference is between poses as the clip has them. The neighbours' pose is the refined one;
    the correction that the model has for this frame is taken off, as the model will add it.
    """
    moment, (a, b, r) = clip.moments[position], _around(clip, position)
    poses = dict(moment.poses)
    for name, own in moment.poses.items():
        before, after = clip.moments[a], clip.moments[b]
        given = pose_between(before.poses[name], after.poses[name], r)
        refined = pose_between(_refined(model, name, before), _refined(model, name, after), r)
        pose = _moved_by_share(refined, given, own, share)
        corrected = _refined(model, name, moment)
        poses[name] = with_rotations(
            pose, pose.rotations - (corrected.rotations - own.rotations)
        ).replace(
            transl=pose.transl - (corrected.transl - own.transl),
            betas=pose.betas - (corrected.betas - own.betas),
        )
    return replace(moment, poses=poses)


def _around(clip: Clip, position: int) -> tuple[int, int, float]:
    """The training frames before and after a frame, itself left out, and where it lies between."""
    others = [p for p in clip.split["train"] if p != position]
    others.sort(key=lambda p: clip.moments[p].time)
    low, high, r = neighbours(clip.moments[position].time, [clip.moments[p].time for p in others])
    return others[low], others[high], r


def _like(clip: Clip, split: str) -> list[int]:
    """Training frames between others that are no farther apart than those about test frames."""

    def apart(position: int) -> float:
        a, b, _ = _around(clip, position)
        return float(clip.moments[b].time - clip.moments[a].time)

    trained = set(clip.split.get("train", ()))
    gaps = {p: apart(p) for p in trained} if len(trained) > 2 else {}
    inner = {p: gap for p, gap in gaps.items() if gap > 0}
    if not inner:
        return []
    widest = max((apart(p) for p in clip.split[split] if p not in trained), default=0.0)
    limit = max(widest, min(inner.values())) + 1e-6
    chosen = sorted(p for p, gap in inner.items() if gap <= limit)
    spread = np.linspace(0, len(chosen) - 1, min(FRAMES, len(chosen))).round().astype(int)
    return [chosen[i] for i in spread]


def _refined(model: SceneModel, name: str, moment: Moment) -> BodyPose:
    """The pose that the model takes for a moment."""
    deformation = model.entity(name).deformation if name in model.entities else None
    if not isinstance(deformation, ProvidesSkeleton):
        return moment.poses[name]
    return deformation.pose(moment.to(model.device)).to("cpu")


def _moved_by_share(pose: BodyPose, before: BodyPose, after: BodyPose, share: float) -> BodyPose:
    """`pose`, turned and moved by a share of what leads from `before` to `after`."""
    one, other, quats = (axis_angle_to_quats(p.rotations) for p in (before, after, pose))
    turns = axis_angle_to_quats(share * turn_between(one, other))
    turned = quats_to_axis_angle(multiply_quats(quats, turns))
    return with_rotations(pose, nearest_axis_angle(turned, pose.rotations)).replace(
        transl=pose.transl + share * (after.transl - before.transl)
    )


def _psnr(model: SceneModel, clip: Clip, position: int, moment: Moment) -> float:
    frame = clip[position]
    color = model.render(moment.to(model.device), frame.camera.to(model.device)).color
    shown = torch.ones(frame.rgb.shape[:2], dtype=torch.bool)
    if frame.ignored is not None:
        shown = ~frame.ignored
    return float(region_psnr(color.clamp(0, 1).cpu(), frame.rgb.cpu(), shown.cpu()))


FIT_STEPS = 40
FIT_RATES = (5e-3, 2e-3)  # initial learning rates, radians and metres: body poses, cameras
FIT_DSSIM = 0.2  # weight of D-SSIM in the image loss


def source_of_poses(clip: Clip, setting: TestPoseSetting) -> TestPose:
    """The protocol of test poses. "auto" is "blended" for a clip whose poses were estimated, and
    "given" for any other."""
    if setting != "auto":
        return setting
    return "blended" if clip.provenance.get(POSES_ESTIMATED) else "given"


def posed_clip(
    model: SceneModel,
    clip: Clip,
    options: ScoreOptions,
    *,
    share: float | None = None,
    progress: Progress | None = None,
) -> Clip:
    """The clip with the poses and cameras of a protocol for the frames of a split.

    "given" changes nothing. "interpolated" takes them from the two neighbouring training frames,
    rotations by SLERP, positions linearly; the model adds its learned corrections, interpolated in
    the same way. "blended" interpolates between these poses and the frame's own by `share`, 0 to 1;
    None estimates it from training frames (`blending.own_share`). "fitted" optimises
    them on the *image that is scored*, with the model frozen, starting from the given ones.
    Training frames and intrinsics never change.

    Views of `clip.held_out` take the body poses of their moments; their cameras stay, and nothing
    is fitted to their images.

    Raises:
        ValueError: there is no training frame to interpolate from.
    """
    report, split = progress or no_progress, options.split
    test_pose, test_camera = source_of_poses(clip, options.test_pose), options.test_camera
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
                model, clip[p], test_pose == "fitted", test_camera == "fitted", options.fit_steps
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
