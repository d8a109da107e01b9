"""Body poses of test frames between their neighbours' and their own, by a share found in training
frames.

A pose between two neighbours is steady, but misses what happened in between; the estimate of the
frame itself has that, and its own error. Which of them is the better differs from clip to clip.
Training frames tell: each is posed as if it were not trained on, and drawn.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from hoigs.core.interfaces.deformation import ProvidesSkeleton
from hoigs.core.maths.rotations import (
    axis_angle_to_quats,
    multiply_quats,
    quats_to_axis_angle,
    turn_between,
)
from hoigs.core.maths.splines import neighbours
from hoigs.core.model.scene import SceneModel
from hoigs.core.progress import Progress, no_progress
from hoigs.core.values.clip import Clip
from hoigs.core.values.moment import BodyPose, Moment
from hoigs.evaluation.interpolation import nearest_axis_angle, pose_between, with_rotations
from hoigs.metrics.psnr import region_psnr

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
        pose = _moved(refined, given, own, share)
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
    others = sorted(
        (p for p in clip.split["train"] if p != position), key=lambda p: clip.moments[p].time
    )
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


def _moved(pose: BodyPose, before: BodyPose, after: BodyPose, share: float) -> BodyPose:
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
