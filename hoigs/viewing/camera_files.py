"""JSON files of keyed cameras: our own, and nerfstudio's camera_path.json."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from torch import Tensor

from hoigs.core.errors import HoigsError
from hoigs.core.files.json_file import parse_json
from hoigs.core.values.between import blend_cameras, moment_between
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip
from hoigs.core.values.moment import Moment


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
