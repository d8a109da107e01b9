"""Cameras that are known already, in metres: cameras.npz beside the video."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float

from hoigs.core.system.npz import load_arrays
from hoigs.core.values.camera import Camera
from hoigs.preparation.cameras.camera_track import CameraTrack
from hoigs.preparation.video.frames import Frames
from hoigs.preparation.video.source import MEGASAM, VGGT, SourceError

EXPECTED_CAMERAS = (
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
        raise SourceError(f"{path}: {error}; {EXPECTED_CAMERAS}") from error
    points = arrays.get("points", np.zeros((0, 3)))
    arrays = {"points": points, "colors": np.full_like(points, 0.5), **arrays}
    needed = {"K": (3, 3), "world_to_camera": (4, 4), "points": (3,), "colors": (3,)}
    for name, shape in needed.items():
        if name not in arrays:
            raise SourceError(f"{path} has no array {name}; {EXPECTED_CAMERAS}")
        if arrays[name].shape[1:] != shape or not np.isfinite(arrays[name]).all():
            raise SourceError(
                f"{path}: {name} is {arrays[name].shape} or not finite; {EXPECTED_CAMERAS}"
            )
    rows, views = len(arrays["K"]), arrays["world_to_camera"]
    if rows != len(views) or rows <= max(video.indices) or len(points) != len(arrays["colors"]):
        raise SourceError(
            f"{path}: {rows} of K, {len(views)} of world_to_camera, {len(points)} points with "
            f"{len(arrays['colors'])} colors, and the video's last frame is {max(video.indices)}; "
            f"{EXPECTED_CAMERAS}"
        )
    views = views[video.indices]
    if not len(points) and np.ptp(views, axis=0).max() > 1e-4:
        raise SourceError(
            f"{path}: the camera moves, and there are no scene points; {EXPECTED_CAMERAS}"
        )
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


# Cameras and depth of MegaSaM (Li et al. 2025): the npz that its depth optimisation writes.

AREA = 384 * 512  # pixels that MegaSaM resizes frames to, before it crops both sides to 8
VIEWS, POINTS = 24, 1500  # frames whose depth gives scene points, and points of each
AGREES = 0.05  # relative difference of depths that see the same surface
FARTHEST = 100.0  # MegaSaM clips depth there
EXPECTED_MEGASAM = (
    "expected images [F, H, W, 3], depths [F, H, W], intrinsic [3, 3], cam_c2w [F, 4, 4]"
)


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
        raise SourceError(f"{path}: {error}; {EXPECTED_MEGASAM}") from error
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
        raise SourceError(f"{path}: its arrays are {shapes}; {EXPECTED_MEGASAM}")
    if frames <= max(video.indices):
        raise SourceError(
            f"{path} has {frames} frames, and the video's last one is {max(video.indices)}: run "
            "MegaSaM on all frames, or choose those that it has with --end"
        )
    back = arrays["cam_c2w"][video.indices].astype(np.float64)
    if not (np.isfinite(back).all() and np.isfinite(arrays["intrinsic"]).all()):
        raise SourceError(f"{path}: cam_c2w or intrinsic is not finite; {EXPECTED_MEGASAM}")
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


# Cameras and depth of VGGT (Wang et al. 2025): the predictions.npz that its demo writes.

SIDE, CELL = 518, 14  # pixels of VGGT's images: their width, and what their height is a multiple of
EXPECTED_VGGT = (
    "expected extrinsic [F, 3, 4], intrinsic [F, 3, 3], depth [F, H, W, 1], images [F, 3, H, W]"
)


def vggt_cameras(video: Frames, path: Path) -> CameraTrack:
    """Cameras of predictions.npz, in a unit of their own, and scene points of its depth.

    A row is a frame of the video. VGGT makes frames 518 pixels wide, their height a multiple of 14,
    and cuts off what is above and below the middle 518; or makes the longer side 518 and adds white
    borders to a square. Points are kept where the depth of other frames agrees.

    Raises:
        SourceError: the file is unreadable, or does not fit the video.
    """
    try:
        arrays = load_arrays(path, only=VGGT)
    except ValueError as error:
        raise SourceError(f"{path}: {error}; {EXPECTED_VGGT}") from error
    _check(arrays, video, path)
    rows = np.array(video.indices)
    images = arrays["images"]
    sizes, offset = _placed(images[rows[0]], video, path)
    K = arrays["intrinsic"][rows].astype(np.float64)
    views = np.tile(np.eye(4), (len(rows), 1, 1))
    views[:, :3] = arrays["extrinsic"][rows]
    chosen = np.unique(np.linspace(0, len(rows) - 1, VIEWS).round().astype(int))
    shown = np.round(255 * images[rows[chosen]].transpose(0, 2, 3, 1))
    depths = arrays["depth"][rows[chosen], ..., 0].astype(np.float64)
    # one focal length in what points are made from: VGGT's differ from frame to frame by little
    points, colors = depth_points(depths, shown, np.median(K, axis=0), views[chosen])
    if not len(points):
        raise SourceError(f"{path}: no point of its depth is seen alike by two frames")
    K[:, :2, 2] += offset
    K[:, :2] *= (np.array((video.width, video.height)) / sizes)[:, None]
    own, poses = torch.from_numpy(K).float(), torch.from_numpy(views).float()
    return CameraTrack(
        [Camera(k, pose, video.width, video.height) for k, pose in zip(own, poses, strict=True)],
        torch.from_numpy(points).float(),
        torch.from_numpy(colors).float(),
        f"VGGT's, given in {path.name}, with {len(points)} points of its depth",
        metric=False,
        positions=tuple(range(len(video))),
    )


def _check(arrays: dict[str, np.ndarray], video: Frames, path: Path) -> None:
    shapes = {name: values.shape for name, values in arrays.items()}
    frames, height, width = (*shapes["depth"], 0, 0, 0)[:3]
    right = {
        "extrinsic": (frames, 3, 4), "intrinsic": (frames, 3, 3),
        "depth": (frames, height, width, 1), "images": (frames, 3, height, width),
    }  # fmt: skip
    if shapes != right:
        raise SourceError(f"{path}: its arrays are {shapes}; {EXPECTED_VGGT}")
    if frames <= max(video.indices):
        raise SourceError(
            f"{path} has {frames} frames, and the video's last one is {max(video.indices)}: its "
            "demo takes one frame a second of a video; give it all frames as images, or prepare a "
            "folder of those that it had"
        )
    known = (arrays[name][video.indices] for name in ("extrinsic", "intrinsic"))
    if not all(np.isfinite(values).all() for values in known):
        raise SourceError(f"{path}: extrinsic or intrinsic is not finite; {EXPECTED_VGGT}")


def _placed(
    image: Float[np.ndarray, "3 H W"], video: Frames, path: Path
) -> tuple[Float[np.ndarray, " 2"], Float[np.ndarray, " 2"]]:
    """Width and height of the whole frame as VGGT resized it, and what is added to pixels of its
    image to have those of the frame."""
    native = np.array((video.native_width, video.native_height))
    size = np.array(image.shape[:0:-1])
    wide = np.array((SIDE, round(native[1] * SIDE / native[0] / CELL) * CELL))
    long = np.round(native * SIDE / native.max() / CELL).astype(int) * CELL
    long[native.argmax()] = SIDE
    bordered = bool((size == SIDE).all() and (long != SIDE).any())
    bordered = bordered and bool((image[:, 0, 0] == 1).all() and (image[:, -1, -1] == 1).all())
    if bordered:
        return long.astype(float), -((SIDE - long) // 2).astype(float)
    if size[0] != wide[0] or size[1] != min(wide[1], SIDE):
        raise SourceError(
            f"{path}: its images are {size[0]}x{size[1]}, of this video of {native[0]}x{native[1]} "
            f"they would be {wide[0]}x{min(wide[1], SIDE)}: run VGGT on this video's frames"
        )
    return wide.astype(float), np.array((0.0, (wide[1] - size[1]) // 2))
