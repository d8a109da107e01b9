"""Cameras and depth of VGGT (Wang et al. 2025): the predictions.npz that its demo writes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from hoigs.core.files.npz import load_arrays
from hoigs.core.values.camera import Camera
from hoigs.preparation.cameras.camera_track import CameraTrack
from hoigs.preparation.cameras.known.megasam import VIEWS, depth_points
from hoigs.preparation.video.frames import Frames
from hoigs.preparation.video.source import VGGT, SourceError

SIDE, CELL = 518, 14  # pixels of VGGT's images: their width, and what their height is a multiple of
EXPECTED = (
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
        raise SourceError(f"{path}: {error}; {EXPECTED}") from error
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
        raise SourceError(f"{path}: its arrays are {shapes}; {EXPECTED}")
    if frames <= max(video.indices):
        raise SourceError(
            f"{path} has {frames} frames, and the video's last one is {max(video.indices)}: its "
            "demo takes one frame a second of a video; give it all frames as images, or prepare a "
            "folder of those that it had"
        )
    known = (arrays[name][video.indices] for name in ("extrinsic", "intrinsic"))
    if not all(np.isfinite(values).all() for values in known):
        raise SourceError(f"{path}: extrinsic or intrinsic is not finite; {EXPECTED}")


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
