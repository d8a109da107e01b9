"""Clips made of the built-in one: without fingers, longer, or seen from its camera's own world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from hoigs.core.model.smpl_params import moved_pose
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import BodyTrack, Clip, FrameStore, ObjectTrack
from hoigs.core.values.moment import BodyPose, Moment


def without_fingers(clip: Clip) -> Clip:
    """Hands that turn as one block, as SMPL has them (here: not at all)."""
    tracks = {
        n: replace(t, poses=t.poses.replace(left_hand=torch.zeros_like(t.poses.left_hand),
                                            right_hand=torch.zeros_like(t.poses.right_hand)))
        for n, t in clip.bodies.items()
    }  # fmt: skip
    return replace(clip, bodies=tracks)


class _Picked(FrameStore):
    def __init__(self, base: FrameStore, frames: Sequence[int]) -> None:
        self.base, self.frames = base, frames

    def image(self, position: int) -> Tensor:
        return self.base.image(self.frames[position])

    def mask(self, entity: str, position: int) -> Tensor:
        return self.base.mask(entity, self.frames[position])

    def depth(self, position: int) -> Tensor | None:
        return self.base.depth(self.frames[position])


def picked(clip: Clip, frames: Sequence[int]) -> Clip:
    """These frames of a clip, in this order; a frame may come again."""
    rows = torch.tensor(frames)

    def pose(p: BodyPose) -> BodyPose:
        return p.map(lambda x: x[rows] if x.dim() > 1 else x)

    last = max(len(frames) - 1, 1)
    return replace(
        clip,
        store=_Picked(clip.store, frames),
        cameras=[clip.cameras[i] for i in frames],
        moments=[Moment(k / last, k) for k in range(len(frames))],
        bodies={n: replace(t, poses=pose(t.poses)) for n, t in clip.bodies.items()},
        objects={
            n: replace(t, rotations=t.rotations[rows], translations=t.translations[rows],
                       observed=t.observed[rows])
            for n, t in clip.objects.items()
        },
        split={"train": list(range(len(frames))), "test": []},
    )  # fmt: skip


def in_camera_world(clip: Clip, pelvis: Tensor) -> Clip:
    """The clip in the world of its first camera. pelvis: J_0(betas) of the body, metres."""
    w2c = clip.cameras[0].world_to_camera.double()
    turn, shift = w2c[:3, :3], w2c[:3, 3]
    back = torch.linalg.inv(w2c)

    def body(track: BodyTrack) -> BodyTrack:
        poses = track.poses.to(torch.float64)
        return replace(
            track, poses=moved_pose(poses, pelvis.double(), turn, shift).to(torch.float32)
        )

    def thing(track: ObjectTrack) -> ObjectTrack:
        rotations = turn @ track.rotations.double()
        places = track.translations.double() @ turn.mT + shift
        return replace(track, rotations=rotations.float(), translations=places.float())

    cameras = [
        Camera(c.K, (c.world_to_camera.double() @ back).float(), c.width, c.height)
        for c in clip.cameras
    ]
    return replace(
        clip,
        cameras=cameras,
        bodies={n: body(t) for n, t in clip.bodies.items()},
        objects={n: thing(t) for n, t in clip.objects.items()},
        points=(clip.points.double() @ turn.mT + shift).float(),
    )
