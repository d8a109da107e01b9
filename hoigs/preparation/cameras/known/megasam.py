"""Cameras and depth of MegaSaM (Li et al. 2025): the npz that its depth optimisation writes."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float

from hoigs.core.files.npz import load_arrays
from hoigs.core.values.camera import Camera
from hoigs.preparation.cameras.camera_track import CameraTrack
from hoigs.preparation.video.frames import Frames
from hoigs.preparation.video.source import MEGASAM, SourceError

AREA = 384 * 512  # pixels that MegaSaM resizes frames to, before it crops both sides to 8
VIEWS, POINTS = 24, 1500  # frames whose depth gives scene points, and points of each
AGREES = 0.05  # relative difference of depths that see the same surface
FARTHEST = 100.0  # MegaSaM clips depth there
EXPECTED = "expected images [F, H, W, 3], depths [F, H, W], intrinsic [3, 3], cam_c2w [F, 4, 4]"


def megasam_cameras(video: Frames, path: Path) -> CameraTrack:
    """Cameras of NAME_sgd_cvd_hr.npz, in a unit of their own, and scene points of its depth.

    A row is a frame of the video. MegaSaM resizes frames to about 384x512 pixels and cuts off
    what is beyond multiples of 8, at the right and at the bottom; its intrinsics are of that image,
    whose first pixel's centre is at (0, 0), and of all frames. Points are kept where the depth of
    other frames agrees; that of what moves does not.

    Raises:
        SourceError: the file is unreadable, or does not fit the video.
    """
    try:
        arrays = load_arrays(path, only=MEGASAM)
    except ValueError as error:
        raise SourceError(f"{path}: {error}; {EXPECTED}") from error
    K, scale, views = _checked(arrays, video, path)
    depths, images = arrays["depths"], arrays["images"]
    chosen = np.unique(np.linspace(0, len(video) - 1, VIEWS).round().astype(int))
    rows = [video.indices[i] for i in chosen]
    points, colors = depth_points(depths[rows].astype(np.float64), images[rows], K, views[chosen])
    if not len(points):
        raise SourceError(f"{path}: no point of its depth is seen alike by two frames")
    own = torch.from_numpy(K * np.append(scale, 1.0)[:, None]).float()
    poses = torch.from_numpy(views).float()
    return CameraTrack(
        [Camera(own, pose, video.width, video.height) for pose in poses],
        torch.from_numpy(points).float(),
        torch.from_numpy(colors).float(),
        f"MegaSaM's, given in {path.name}, with {len(points)} points of its depth",
        metric=False,
        positions=tuple(range(len(video))),
    )


def _checked(
    arrays: dict[str, np.ndarray], video: Frames, path: Path
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 2"], Float[np.ndarray, "F 4 4"]]:
    """Intrinsics with the first pixel's centre at (0.5, 0.5), width and height of the frames given
    out over those of MegaSaM's image before the cut, and world_to_camera of the chosen frames."""
    shapes = {name: values.shape for name, values in arrays.items()}
    frames, height, width = (*shapes["depths"], 0, 0, 0)[:3]
    right = {
        "images": (frames, height, width, 3), "depths": (frames, height, width),
        "intrinsic": (3, 3), "cam_c2w": (frames, 4, 4),
    }  # fmt: skip
    if shapes != right:
        raise SourceError(f"{path}: its arrays are {shapes}; {EXPECTED}")
    if frames <= max(video.indices):
        raise SourceError(
            f"{path} has {frames} frames, and the video's last one is {max(video.indices)}: run "
            "MegaSaM on all frames, or choose those that it has with --end"
        )
    back = arrays["cam_c2w"][video.indices].astype(np.float64)
    if not (np.isfinite(back).all() and np.isfinite(arrays["intrinsic"]).all()):
        raise SourceError(f"{path}: cam_c2w or intrinsic is not finite; {EXPECTED}")
    native = np.array([video.native_width, video.native_height])
    resized = (native * math.sqrt(AREA / native.prod())).astype(int)
    kept = np.array([width, height])
    if tuple(resized // 8 * 8) != tuple(kept):
        resized = kept  # by another version: taken as a whole
        if abs(native[0] * height / (native[1] * width) - 1) > 0.05:
            raise SourceError(
                f"{path}: its images are {width}x{height}, the video {native[0]}x{native[1]}; "
                "one is not the other, resized"
            )
    scale = np.array([video.width, video.height]) / resized
    K = arrays["intrinsic"].astype(np.float64)
    K[:2, 2] += 0.5
    return K, scale, np.linalg.inv(back)


def depth_points(
    depths: Float[np.ndarray, "V H W"],
    images: np.ndarray,
    K: Float[np.ndarray, "3 3"],
    views: Float[np.ndarray, "V 4 4"],
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"]]:
    """World points of a grid of pixels, and their colours, where other frames' depth agrees."""
    count, height, width = depths.shape
    step = max(1, round(math.sqrt(height * width / POINTS)))
    y, x = (v.ravel() for v in np.mgrid[step // 2 : height : step, step // 2 : width : step])
    rays = np.stack((x + 0.5, y + 0.5, np.ones(len(x))), -1) @ np.linalg.inv(K).T
    points, colors = [], []
    for i in range(count):
        depth = depths[i, y, x]
        known = np.isfinite(depth) & (depth > 0) & (depth < FARTHEST)
        seen = rays[known] * depth[known, None]
        world = (seen - views[i, :3, 3]) @ views[i, :3, :3]
        still = _still(world, depths, K, views, i)
        points.append(world[still])
        colors.append(images[i, y, x][known][still] / 255.0)
    return np.concatenate(points), np.concatenate(colors)


def _still(
    world: Float[np.ndarray, "P 3"],
    depths: Float[np.ndarray, "V H W"],
    K: Float[np.ndarray, "3 3"],
    views: Float[np.ndarray, "V 4 4"],
    own: int,
) -> Bool[np.ndarray, " P"]:
    """Points that more frames see where they are than look through."""
    agree, through = np.zeros(len(world)), np.zeros(len(world))
    height, width = depths.shape[1:]
    for j, view in enumerate(views):
        if j == own:
            continue
        seen = world @ view[:3, :3].T + view[:3, 3]
        z = np.maximum(seen[:, 2], 1e-6)
        column, row = np.floor((seen[:, :2] / z[:, None]) @ K[:2, :2].T + K[:2, 2]).T
        shown = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (seen[:, 2] > 0)
        there = depths[j, row[shown].astype(int), column[shown].astype(int)] / z[shown]
        agree[shown] += np.abs(there - 1) < AGREES
        through[shown] += there > 1 + AGREES
    return agree > 2 * through
