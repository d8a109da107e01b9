"""Paths of films: which moment is seen from which camera, frame by frame."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from torch import Tensor

from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.model.scene import SceneModel
from hoigs.core.system.files import parse_json
from hoigs.core.values.between import (
    blend_cameras,
    camera_between,
    frame_of,
    in_shape,
    moment_between,
)
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip
from hoigs.core.values.moment import Moment
from hoigs.evaluation.measure import orbit_cameras, pivot, turned

# JSON files of keyed cameras: our own, and nerfstudio's camera_path.json.


class Key(BaseModel):
    """A camera at a share of the film, in the world of the clip, metres."""

    model_config = ConfigDict(extra="forbid", use_attribute_docstrings=True)

    at: float = Field(ge=0, le=1)
    """share of the film"""
    position: tuple[float, float, float]
    look_at: tuple[float, float, float]
    fov: float | None = Field(default=None, gt=1, lt=170)
    """vertical, degrees; by default that of the video"""
    frame: float | None = Field(default=None, ge=0)
    """frame number of the clip that is seen; by default the clip plays"""


class KeyFile(BaseModel):
    """`{"keys": [{"at": 0, "position": [0, 0, -3], "look_at": [0, 0, 0]}, …]}`."""

    model_config = ConfigDict(extra="forbid")

    keys: list[Key] = Field(min_length=1)


def read_camera_path(
    path: Path, clip: Clip, frames: Sequence[float]
) -> list[tuple[Moment, Camera]]:
    """The views of a film from a file.

    Args:
        frames: frame numbers at which the clip plays; their number is that of the pictures, but a
            file of nerfstudio has its own.

    Raises:
        HoigsError: the file is absent or not understood.
    """
    content = _read(path)
    if isinstance(content, dict) and "camera_path" in content:
        return _nerfstudio(path, content, clip, frames)
    try:
        keys = sorted(KeyFile.model_validate(content).keys, key=lambda key: key.at)
    except ValidationError as error:
        problem = error.errors()[0]
        place = ".".join(map(str, problem["loc"]))
        raise HoigsError(
            f"{path}: {place}: {problem['msg']}; expected keys with at, position and look_at, or "
            "nerfstudio's camera_path"
        ) from error
    cameras = [_keyed(path, key, clip) for key in keys]
    views = []
    for i, playing in enumerate(frames):
        share = i / max(1, len(frames) - 1)
        after = next((k for k, key in enumerate(keys) if key.at >= share), len(keys) - 1)
        before = max(0, after - 1) if keys[after].at >= share else after
        a, b = keys[before], keys[after]
        r = min(max((share - a.at) / (b.at - a.at), 0.0), 1.0) if b.at > a.at else 0.0
        r = r * r * (3 - 2 * r)
        frame = playing
        if a.frame is not None and b.frame is not None:
            frame = a.frame + r * (b.frame - a.frame)
        camera = blend_cameras(cameras[before], cameras[after], r)
        views.append((moment_between(clip, frame), camera))
    return views


def rate_of(path: Path) -> float | None:
    """Pictures a second that a file of nerfstudio gives by its `seconds`; None if there are none.

    Raises:
        HoigsError: the file is absent or not understood.
    """
    content = _read(path)
    if not isinstance(content, dict) or "camera_path" not in content:
        return None
    try:
        count, seconds = len(content["camera_path"]), float(content.get("seconds") or 0)
    except (TypeError, ValueError) as error:
        raise HoigsError(f"{path}: its camera_path or seconds: {error}") from error
    return count / seconds if count and 0 < seconds < math.inf else None


def _read(path: Path) -> Any:
    try:
        return parse_json(path)
    except (OSError, ValueError) as error:
        raise HoigsError(f"{path}: expected a JSON file of cameras: {error}") from error


def _keyed(path: Path, key: Key, clip: Clip) -> Camera:
    first = clip.cameras[0]
    up = clip.up()
    fov = 2 * math.atan(first.height / (2 * float(first.K[1, 1])))
    try:
        return Camera.look_at(
            torch.tensor(key.position), torch.tensor(key.look_at), width=first.width,
            height=first.height, fov_y=fov if key.fov is None else math.radians(key.fov),
            up=(float(up[0]), float(up[1]), float(up[2])),
        )  # fmt: skip
    except ValueError as error:
        raise HoigsError(f"{path}: key at {key.at:g}: {error}") from error


def _nerfstudio(
    path: Path, content: dict[str, Any], clip: Clip, frames: Sequence[float]
) -> list[tuple[Moment, Camera]]:
    """Every camera of the file; the clip plays once over them, or as `render_time` has it."""
    kind = content.get("camera_type", "perspective")
    if kind != "perspective":
        raise HoigsError(f"{path}: camera_type {kind!r}: expected 'perspective'")
    if content.get("crop") is not None:
        raise HoigsError(f"{path}: its crop cannot be drawn; remove it, and choose by --entities")
    last = clip.num_frames - 1
    try:
        width, height = int(content["render_width"]), int(content["render_height"])
        entries = content["camera_path"]
        cameras = [_opengl(entry, width, height) for entry in entries]
        shares = [i / max(1, len(entries) - 1) for i in range(len(entries))]
        numbers = [
            float(entry["render_time"]) * last if "render_time" in entry
            else frames[0] + share * (frames[-1] - frames[0])
            for entry, share in zip(entries, shares, strict=True)
        ]  # fmt: skip
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise HoigsError(
            f"{path}: no camera_path.json of nerfstudio: {type(error).__name__}: {error}"
        ) from error
    if not cameras:
        raise HoigsError(f"{path}: its camera_path is empty")
    return [(moment_between(clip, f), c) for f, c in zip(numbers, cameras, strict=True)]


def _opengl(entry: dict[str, Any], width: int, height: int) -> Camera:
    """A camera of nerfstudio: x right, y up, z backward."""
    pose: Float[Tensor, "4 4"] = torch.tensor(entry["camera_to_world"]).float().reshape(4, 4)
    pose = pose @ torch.diag(torch.tensor((1.0, -1.0, -1.0, 1.0)))
    focal = height / (2 * math.tan(math.radians(float(entry["fov"])) / 2))
    K = torch.tensor(((focal, 0.0, width / 2), (0.0, focal, height / 2), (0.0, 0.0, 1.0)))
    return Camera(K, torch.linalg.inv(pose), width, height)


View = tuple[Moment, Camera]
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
    clip = _of_one_size(clip)
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
        eased = share * share * (3 - 2 * share)  # slow at both ends
        yaw = math.radians(BULLET_DEGREES) * math.sin(2 * math.pi * eased)
        around.append((still, turned(camera, center, axis_angle_to_matrices(up * yaw))))
    plays = [(f, (moment_between(clip, f), camera_between(clip, f))) for f in frames]
    before = [view for f, view in plays if f <= stop]
    return [*before, *around, *(view for f, view in plays if f > stop)]


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
