"""Cameras that are known already, in metres: cameras.npz beside the video."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from hoigs.core.files.npz import load_arrays
from hoigs.core.values.camera import Camera
from hoigs.preparation.cameras.camera_track import CameraTrack
from hoigs.preparation.video.frames import Frames
from hoigs.preparation.video.source import SourceError

EXPECTED = (
    "expected K [F, 3, 3] (pixels of the video), world_to_camera [F, 4, 4] (metres, OpenCV axes), "
    "a row a frame of the video, and points [P, 3], colors [P, 3] (RGB in [0, 1]) of the scene"
)


def given_cameras(video: Frames, path: Path) -> CameraTrack:
    """Pinhole cameras in metres, as a tracking phone or a calibrated rig has them.

    Scene points may be absent if the camera stands still.

    Raises:
        SourceError: the file is unreadable, or does not fit the video.
    """
    try:
        arrays = load_arrays(path)
    except ValueError as error:
        raise SourceError(f"{path}: {error}; {EXPECTED}") from error
    points = arrays.get("points", np.zeros((0, 3)))
    arrays = {"points": points, "colors": np.full_like(points, 0.5), **arrays}
    needed = {"K": (3, 3), "world_to_camera": (4, 4), "points": (3,), "colors": (3,)}
    for name, shape in needed.items():
        if name not in arrays:
            raise SourceError(f"{path} has no array {name}; {EXPECTED}")
        if arrays[name].shape[1:] != shape or not np.isfinite(arrays[name]).all():
            raise SourceError(f"{path}: {name} is {arrays[name].shape} or not finite; {EXPECTED}")
    rows, views = len(arrays["K"]), arrays["world_to_camera"]
    if rows != len(views) or rows <= max(video.indices) or len(points) != len(arrays["colors"]):
        raise SourceError(
            f"{path}: {rows} of K, {len(views)} of world_to_camera, {len(points)} points with "
            f"{len(arrays['colors'])} colors, and the video's last frame is {max(video.indices)}; "
            f"{EXPECTED}"
        )
    views = views[video.indices]
    if not len(points) and np.ptp(views, axis=0).max() > 1e-4:
        raise SourceError(f"{path}: the camera moves, and there are no scene points; {EXPECTED}")
    scale = video.width / video.native_width
    K = torch.from_numpy(arrays["K"][video.indices]).float() * torch.tensor(
        [[scale], [video.height / video.native_height], [1.0]]
    )
    poses = torch.from_numpy(views).float()
    return CameraTrack(
        [Camera(k, pose, video.width, video.height) for k, pose in zip(K, poses, strict=True)],
        torch.from_numpy(points).float(),
        torch.from_numpy(arrays["colors"]).float(),
        f"given in {path.name}, metres, {len(points)} scene points",
        metric=True,
        positions=tuple(range(len(video))),
    )
