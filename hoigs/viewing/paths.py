"""Paths of films: which moment is seen from which camera, frame by frame."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.model.scene import SceneModel
from hoigs.core.values.between import camera_between, frame_of, in_shape, moment_between
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip
from hoigs.core.values.moment import Moment
from hoigs.evaluation.orbits import orbit_cameras, pivot, turned
from hoigs.viewing.camera_files import read_camera_path

View = tuple[Moment, Camera]
OLDER = {"playback": "video"}
BULLET_DEGREES = 25.0  # to each side: what a single video has seen of the far side is little
BULLET_SECONDS = 4.0
SMOOTHING = 0.25  # seconds over which the place of what is followed is averaged


def film_path(
    model: SceneModel,
    clip: Clip,
    path: str,
    frames: Sequence[float],
    fps: float,
    at: float | None = None,
) -> list[View]:
    """The views of a film, all of one size: where the clip has several, that of most pictures, into
    which the others are fitted whole, with more of the world beside them.

    Args:
        path: "video", "orbit", "bullet-time", "spiral", "follow NAME" (or "human" or "object"), or
            a JSON file of cameras.
        frames: frame number of the clip for each picture, where the clip plays.
        fps: pictures a second. at: frame number at which bullet-time stands still.

    Raises:
        HoigsError: no such path or entity, or a camera file that cannot be read.
    """
    path, clip = OLDER.get(path, path), _of_one_size(clip)
    if path.lower().endswith(".json"):
        return read_camera_path(Path(path), clip, frames)
    name, _, target = path.partition(" ")
    known: dict[str, Callable[[], list[View]]] = {
        "video": lambda: [(moment_between(clip, f), camera_between(clip, f)) for f in frames],
        "orbit": lambda: _at(clip, frames, orbit_cameras(clip, model, len(frames))),
        "bullet-time": lambda: bullet_time(model, clip, frames, fps, at),
        "spiral": lambda: _at(clip, frames, spiral(model, clip, len(frames))),
        "follow": lambda: follow(model, clip, frames, fps, target),
    }
    if name not in known or (target and name != "follow"):
        names = [*(n for n in known if n != "follow"), "follow human", "follow object"]
        raise HoigsError(
            f"path {path!r}{did_you_mean(path, names)}; expected {', '.join(names)}, or a JSON file"
        )
    return known[name]()


def _of_one_size(clip: Clip) -> Clip:
    sizes = Counter((camera.width, camera.height) for camera in clip.cameras)
    if len(sizes) == 1:
        return clip
    (size, _), *_ = sizes.most_common()
    cameras = [c if (c.width, c.height) == size else in_shape(c, *size) for c in clip.cameras]
    return replace(clip, cameras=cameras)


def _at(clip: Clip, frames: Sequence[float], cameras: Sequence[Camera]) -> list[View]:
    moments = [moment_between(clip, frame) for frame in frames]
    return list(zip(moments, cameras, strict=True))


def bullet_time(
    model: SceneModel, clip: Clip, frames: Sequence[float], fps: float, at: float | None = None
) -> list[View]:
    """The clip plays up to a moment, stands still while the camera goes to both sides, and goes on.

    Args:
        at: frame number of that moment; by default `best_moment`.
    """
    stop = best_moment(model, clip, frames) if at is None else at
    still = moment_between(clip, stop)
    camera = camera_between(clip, stop)
    center = pivot(model, clip, still, camera)
    up = clip.up().to(center)
    around = []
    count = max(2, round(BULLET_SECONDS * fps))
    for i in range(count):
        share = i / count
        yaw = math.radians(BULLET_DEGREES) * math.sin(2 * math.pi * _eased(share))
        around.append((still, turned(camera, center, axis_angle_to_matrices(up * yaw))))
    plays = [(f, (moment_between(clip, f), camera_between(clip, f))) for f in frames]
    before = [view for f, view in plays if f <= stop]
    return [*before, *around, *(view for f, view in plays if f > stop)]


def _eased(share: float) -> float:
    """Slow at both ends, in [0, 1]."""
    return share * share * (3 - 2 * share)


@torch.no_grad()
def best_moment(model: SceneModel, clip: Clip, frames: Sequence[float]) -> float:
    """The frame number at which the objects, or without any the people, move fastest.

    The first and the last tenth do not count, so that something comes before and after.
    """
    names = model.names("object") or model.names("human")
    cut = max(1, len(frames) // 10)
    inner = list(frames[cut:-cut]) or list(frames)
    if not names or len(inner) < 3:
        return inner[len(inner) // 2]
    places = _centers(model, clip, inner, names)
    speed = (places[2:] - places[:-2]).norm(dim=-1)
    return inner[1 + int(speed.argmax())]


def _centers(
    model: SceneModel, clip: Clip, frames: Sequence[float], names: Sequence[str]
) -> Float[Tensor, "F 3"]:
    """Mean of the Gaussians of some entities at each frame, metres, on the CPU."""
    means = []
    for frame in frames:
        state = model(moment_between(clip, frame).to(model.device), names)
        means.append(state.joined(names).means.mean(0).cpu())
    return torch.stack(means)


def spiral(model: SceneModel, clip: Clip, count: int) -> list[Camera]:
    """Two turns about the middle camera, whose distance to the subject swells and shrinks.

    The camera looks at the subject throughout, as in LLFF (Mildenhall et al. 2019).
    """
    position = len(clip) // 2
    camera = clip.cameras[position]
    center = pivot(model, clip, clip.moments[position], camera)
    reach = float((camera.center - center).norm())
    axes = camera.world_to_camera[:3, :3]
    cameras = []
    for i in range(count):
        turn = 4 * math.pi * i / max(1, count)
        radius = math.radians(10.0) * reach
        depth = 0.12 * reach * math.sin(turn / 2)
        away = torch.tensor((radius * math.cos(turn), 0.6 * radius * math.sin(turn), depth))
        eye = camera.center + axes.mT @ away.to(axes)
        cameras.append(_looking(camera, eye, center, clip.up().to(axes)))
    return cameras


def _looking(
    camera: Camera, eye: Float[Tensor, " 3"], target: Float[Tensor, " 3"], up: Float[Tensor, " 3"]
) -> Camera:
    """The same lens at `eye`, with `target` where `camera` has it in the picture."""
    aimed = Camera.look_at(
        eye, target, width=camera.width, height=camera.height, fov_y=1.0,
        up=(float(up[0]), float(up[1]), float(up[2])),
    )  # fmt: skip
    pixel = camera.project(target[None])[0][0]
    K = camera.K.clone()
    K[:2, 2] = pixel  # the target lies on the optical axis
    return replace(aimed, K=K)


@torch.no_grad()
def follow(
    model: SceneModel, clip: Clip, frames: Sequence[float], fps: float, target: str
) -> list[View]:
    """The middle camera of the video, carried along with an entity, its direction unchanged.

    Args:
        target: name of an entity, or of a kind: its first entity.

    Raises:
        HoigsError: there is none.
    """
    names = model.names(target) or [n for n in model.names() if n == target]
    if not names or target == "scene":
        known = [n for n in model.names() if model.entity(n).kind != "scene"]
        raise HoigsError(f'follow "{target}": expected one of {", ".join(known)}')
    middle = float(clip.moments[len(clip) // 2].index)
    camera = camera_between(clip, middle)
    places = _smoothed(_centers(model, clip, frames, names[:1]), SMOOTHING * fps)
    start = _centers(model, clip, [middle], names[:1])[0]
    views = []
    for frame, place in zip(frames, places, strict=True):
        pose = camera.world_to_camera.clone()
        pose[:3, 3] -= pose[:3, :3] @ (place - start).to(pose)
        views.append((moment_between(clip, frame), replace(camera, world_to_camera=pose)))
    return views


def _smoothed(places: Float[Tensor, "F 3"], width: float) -> Float[Tensor, "F 3"]:
    """Averaged in time by a Gaussian of a standard deviation of `width` places."""
    if width < 0.5:
        return places
    steps = torch.arange(len(places), dtype=places.dtype)
    weights = (-0.5 * ((steps[:, None] - steps) / width) ** 2).exp()
    return weights @ places / weights.sum(1, keepdim=True)


def frames_shown(clip: Clip, views: Sequence[View]) -> list[float]:
    """The frame number of the clip that each view shows."""
    return [frame_of(clip, moment) for moment, _ in views]
