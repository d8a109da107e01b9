"""Body poses and cameras of scored frames, by protocol: given, interpolated or fitted."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.camera import Camera
from hoigs.core.clip import Clip, Frame
from hoigs.core.moment import BodyPose, Moment
from hoigs.core.neighbours import neighbours
from hoigs.core.rotation import (
    axis_angle_to_quats,
    matrices_to_quats,
    quats_to_axis_angle,
    quats_to_matrices,
    slerp,
)
from hoigs.core.scene import SceneModel
from hoigs.evaluation.metrics import ssim
from hoigs.evaluation.protocol import TestPose

FIT_STEPS = 40
FIT_RATES = (5e-3, 2e-3)  # radians and metres a step at the start: of body poses, of cameras


def posed_clip(
    model: SceneModel,
    clip: Clip,
    *,
    split: str = "test",
    test_pose: TestPose = "given",
    test_camera: TestPose = "given",
    fit_steps: int = FIT_STEPS,
    progress: Callable[[float, str], None] | None = None,
) -> Clip:
    """The clip with the poses and cameras that a protocol gives to the frames of a split.

    "given" leaves them alone. "interpolated" takes them from the two training frames about each in
    time, rotations by SLERP, places linearly; what the model has learned to add to poses it then
    adds as ever, interpolated likewise. "fitted" optimises them on the *image that is scored*, from
    the given ones on (or the interpolated, of cameras under fitted poses and the reverse), the
    model frozen. Frames that were trained on, and intrinsics, always stay.

    Views of `clip.held_out` get the body poses of their moments; their cameras stay, and nothing
    is ever fitted to their images.

    Raises:
        ValueError: there is no training frame to interpolate from.
    """
    trained = sorted(clip.split.get("train", ()), key=lambda p: clip.moments[p].time)
    chosen = [p for p in clip.split[split] if p not in set(trained)]
    if "interpolated" in (test_pose, test_camera) and chosen:
        if not trained:
            raise ValueError("nothing to interpolate from: the clip has no training frames")
        clip = _interpolated(clip, trained, chosen, test_pose, test_camera)
    if "fitted" in (test_pose, test_camera):
        moments, cameras = list(clip.moments), list(clip.cameras)
        for done, p in enumerate(chosen):
            fit = fit_frame(
                model, clip[p], test_pose == "fitted", test_camera == "fitted", fit_steps
            )
            moments[p], cameras[p] = fit.moment, fit.camera
            if progress is not None:
                progress((done + 1) / len(chosen), "fitting poses to test images")
        clip = replace(clip, moments=moments, cameras=cameras)
    if clip.held_out is None or test_pose == "given":
        return clip
    changed = {clip.moments[p].index: clip.moments[p] for p in chosen}
    views = [changed.get(m.index, m) for m in clip.held_out.moments]
    return replace(clip, held_out=replace(clip.held_out, moments=views))


def _interpolated(
    clip: Clip, trained: list[int], chosen: list[int], pose: TestPose, camera: TestPose
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


def pose_between(a: BodyPose, b: BodyPose, r: float) -> BodyPose:
    """Joints by SLERP, place and shape linearly; r in [0, 1]."""
    turned = quats_to_axis_angle(
        slerp(axis_angle_to_quats(a.rotations), axis_angle_to_quats(b.rotations), r)
    )
    turned = _nearest_form(turned, a.rotations)
    return a.replace(
        global_orient=turned[0],
        body=turned[1:22],
        left_hand=turned[22:37],
        right_hand=turned[37:],
        transl=torch.lerp(a.transl, b.transl, r),
        betas=torch.lerp(a.betas, b.betas, r),
    )


def _nearest_form(
    vectors: Float[Tensor, "J 3"], beside: Float[Tensor, "J 3"]
) -> Float[Tensor, "J 3"]:
    """Of the two axis-angle forms of each rotation the one nearer to `beside`.

    Corrections that are added to axis-angles were learned beside the neighbours' form; about half
    a turn the other form would take them backwards.
    """
    angle = vectors.norm(dim=-1, keepdim=True)
    other = vectors - 2 * math.pi * vectors / angle.clamp_min(1e-6)
    nearer = (other - beside).norm(dim=-1) < (vectors - beside).norm(dim=-1)
    return torch.where(nearer[:, None] & (angle > 1e-3), other, vectors)


def camera_between(a: Camera, b: Camera, r: float) -> Camera:
    """Rotation by SLERP, centre linearly; the intrinsics of `a`; r in [0, 1]."""
    quats = [matrices_to_quats(c.world_to_camera[:3, :3]) for c in (a, b)]
    R = quats_to_matrices(slerp(quats[0], quats[1], r))
    viewmat = a.world_to_camera.clone()
    viewmat[:3, :3] = R
    viewmat[:3, 3] = -R @ torch.lerp(a.center, b.center, r)
    return replace(a, world_to_camera=viewmat)


@dataclass(frozen=True)
class FrameFit:
    """A frame whose body poses or camera were optimised on its image.

    Attributes:
        loss: at the start and of the best step, which is the one that is kept.
    """

    moment: Moment
    camera: Camera
    loss: tuple[float, float]


def fit_frame(
    model: SceneModel, frame: Frame, poses: bool, camera: bool, steps: int = FIT_STEPS
) -> FrameFit:
    """Optimise body poses, the camera or both on one frame's image, with the model frozen.

    0.8 L1 + 0.2 (1 - SSIM) of the whole image, Adam with a rate that falls to zero by a cosine; the
    best step is kept, so that a fit is never worse than its start. ExAvatar fits its test frames so
    (methods A.9: mks0601/ExAvatar_RELEASE#51, 31 to 36 dB).

    Args:
        poses: of every human that the model has. camera: turn and shift, not the intrinsics.
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

    def guess() -> tuple[Moment, Camera]:
        moment = given
        for n in names:
            moment = moment.with_pose(n, _moved(given.poses[n], turns[n], shifts[n]))
        return moment, start.moved(*view) if camera else start

    def kept() -> tuple[Moment, Camera]:
        moment, at = guess()
        return (
            replace(moment, poses={n: p.map(torch.detach) for n, p in moment.poses.items()}),
            replace(at, world_to_camera=at.world_to_camera.detach()),
        )

    adam = torch.optim.Adam(groups)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(adam, steps)
    losses: list[float] = []
    best = kept()
    with _frozen(model):
        for step in range(steps + 1):  # the last only looks at what the one before it has made
            color = model.render(*guess()).color
            if hidden is not None:
                color = torch.where(hidden, target, color)
            loss = 0.8 * (color - target).abs().mean() + 0.2 * (1 - ssim(color, target))
            if not losses or float(loss.detach()) < min(losses):
                best = kept()
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
    """No parameter of the model takes a gradient within, whoever has called with or without."""
    trained = [p for p in model.parameters() if p.requires_grad]
    model.requires_grad_(False)
    try:
        with torch.enable_grad():
            yield
    finally:
        for parameter in trained:
            parameter.requires_grad_(True)
