"""Moments and cameras of a clip at frame numbers that need not be whole."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence

import torch
from torch import Tensor

from hoigs.core.errors import HoigsError
from hoigs.core.maths.frame_times import frame_at, time_of
from hoigs.core.maths.rotations import (
    axis_angle_to_quats,
    matrices_to_quats,
    quats_to_axis_angle,
    quats_to_matrices,
    slerp,
)
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip
from hoigs.core.values.moment import BodyPose, Moment

MOST_MOMENTS = 100_000


def frame_numbers(
    clip: Clip,
    start: float | None = None,
    end: float | None = None,
    fps: float | None = None,
    slow: float = 1.0,
) -> tuple[list[float], float]:
    """Frame numbers from `start` to `end`, evenly spaced in time, and how many a second there are.

    Args:
        start, end: by default the first and the last. fps: by default the clip's.
        slow: how many times slower than the clip they play.

    Raises:
        HoigsError: frames that the clip has not, or a rate that is not positive.
    """
    last = clip.num_frames - 1
    first, final = (0.0 if start is None else start), (float(last) if end is None else end)
    for option, frame in (("--from", first), ("--to", final)):
        if not 0 <= frame <= last:
            raise HoigsError(f"{option} {frame:g}: the clip has frames 0 to {last}")
    if first > final:
        raise HoigsError(f"--from {first:g} is behind --to {final:g}: no frame is left")
    rate = clip.fps if fps is None else fps
    for option, value in (("--fps", rate), ("--slow", slow)):
        if not 0 < value < math.inf:
            raise HoigsError(f"{option} {value:g}: expected a positive number")
    step = clip.fps / (rate * slow)
    count, times = clip.num_frames, clip.frame_times
    # in mean gaps between frames: the frame numbers themselves, where frames are evenly spaced
    begin, finish = (time_of(frame, count, times) * last for frame in (first, final))
    if times is None:
        begin, finish = first, final
    found = math.floor((finish - begin) / step + 1e-6) + 1
    if found > MOST_MOMENTS:
        raise HoigsError(f"{found} moments are more than {MOST_MOMENTS}; lower --fps or --slow")
    places = [begin + i * step for i in range(found)]
    if times is not None:
        places = [float(frame_at(place / last, count, times)) for place in places]
    return [_whole(place) for place in places], rate


def _whole(frame: float) -> float:
    """A frame number that rounding took off a whole one, back on it."""
    return float(round(frame)) if abs(frame - round(frame)) < 1e-6 else frame


def frame_of(clip: Clip, moment: Moment) -> float:
    """The frame number of a moment, between frames a fraction."""
    if clip.frame_times is None:
        return float(moment.time) * max(clip.num_frames - 1, 1)
    return float(frame_at(float(moment.time), clip.num_frames, clip.frame_times))


def moment_between(clip: Clip, frame: float) -> Moment:
    """The clip at a frame number: joints by slerp, translations linearly between two frames.

    Before the first frame and after the last, the pose is theirs.
    """
    low, high, r = _neighbours(clip, frame)
    time = time_of(frame, clip.num_frames, clip.frame_times)
    before, after = clip.moments[low], clip.moments[high]
    index = (before if r < 0.5 else after).index
    if r == 0.0:
        return Moment(before.time if before.index == frame else time, index, before.poses)
    shared = [name for name in before.poses if name in after.poses]
    poses = {name: blend_poses(before.poses[name], after.poses[name], r) for name in shared}
    return Moment(time, index, poses)


def blend_poses(a: BodyPose, b: BodyPose, r: float) -> BodyPose:
    """The pose a share r of the way from `a` to `b`."""

    def turned(x: Tensor, y: Tensor) -> Tensor:
        return quats_to_axis_angle(slerp(axis_angle_to_quats(x), axis_angle_to_quats(y), r))

    return a.replace(
        global_orient=turned(a.global_orient, b.global_orient),
        body=turned(a.body, b.body),
        left_hand=turned(a.left_hand, b.left_hand),
        right_hand=turned(a.right_hand, b.right_hand),
        transl=torch.lerp(a.transl, b.transl, r),
        betas=torch.lerp(a.betas, b.betas, r),
    )


def camera_between(clip: Clip, frame: float) -> Camera:
    """The clip's camera at a frame number: rotation by slerp, centre and intrinsics linearly."""
    low, high, r = _neighbours(clip, frame)
    return blend_cameras(clip.cameras[low], clip.cameras[high], r)


def blend_cameras(a: Camera, b: Camera, r: float) -> Camera:
    """The camera a share r of the way from `a` to `b`, in the image size of `a`."""
    if r == 0.0:
        return a
    for camera in (a, b):
        camera.need_pinhole("blend_cameras")
    b = in_shape(b, a.width, a.height)
    before, after = (matrices_to_quats(c.world_to_camera[:3, :3]) for c in (a, b))
    rotation = quats_to_matrices(slerp(before, after, r))
    pose = torch.eye(4).to(a.world_to_camera)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ torch.lerp(a.center, b.center, r)
    return Camera(torch.lerp(a.K, b.K, r), pose, a.width, a.height)


def in_shape(camera: Camera, width: int, height: int) -> Camera:
    """The camera with its whole image in the middle of one of another size and aspect."""
    scale = min(width / camera.width, height / camera.height)
    wide, high = (max(1, round(scale * side)) for side in (camera.width, camera.height))
    left, top = (width - wide) // 2, (height - high) // 2
    return camera.resized(wide, high).cropped(-left, -top, width, height)


def _neighbours(clip: Clip, frame: float) -> tuple[int, int, float]:
    """Positions of the frames before and after, and the share of the way between them."""
    order = sorted(range(len(clip)), key=lambda i: clip.moments[i].index)
    indices: Sequence[int] = [clip.moments[i].index for i in order]
    place = bisect_right(indices, frame)
    if place == 0:
        return order[0], order[0], 0.0
    low = place - 1
    if low == len(indices) - 1 or indices[low] == frame:
        return order[low], order[low], 0.0
    r = (frame - indices[low]) / (indices[low + 1] - indices[low])
    return order[low], order[low + 1], r
