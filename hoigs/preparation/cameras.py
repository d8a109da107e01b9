"""Cameras of a video: COLMAP's, with the lens distortion taken out, or one that stands still."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from hoigs.core.camera import Camera
from hoigs.preparation.frames import VideoFrames
from hoigs.preparation.source import SourceError

ASSUMED_FOCAL = 0.8  # of the longer side: 64 degrees, a phone's main camera
NEGLIGIBLE_SHIFT = 0.01  # pixels of distortion that nothing here can see


@dataclass(frozen=True)
class CameraTrack:
    """Pinhole cameras of all frames, and the way from the video's pixels to theirs.

    Attributes:
        cameras: one a frame, at the width of the frames given out.
        undistort: images, masks and pixel positions of the video to those of `cameras`.
        points, colors: scene points in the cameras' own unit, RGB in [0, 1]; none if static.
        provenance: for the clip and the report.
        metric: whether the world is in metres already (a static camera has no scale of its own).
    """

    cameras: list[Camera]
    undistort: Undistortion
    points: Float[Tensor, "P 3"]
    colors: Float[Tensor, "P 3"]
    provenance: str
    metric: bool


class Undistortion:
    """Maps a distorted image onto its pinhole camera.

    Args:
        source: [H, W, 2] where each pinhole pixel lies in the video frame, pixels; None if the
            video is a pinhole image already.
        forward: video pixels [N, 2] to pinhole pixels [N, 2]; None for the identity.
    """

    def __init__(
        self, source: Float[np.ndarray, "H W 2"] | None = None, forward: Any | None = None
    ) -> None:
        self._forward = forward
        self._grid: Tensor | None = None
        self.largest_shift = 0.0
        if source is not None:
            height, width = source.shape[:2]
            size = np.array([width, height])
            self._grid = torch.from_numpy((2 * source / size - 1).astype(np.float32))[None]

    def image(self, image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
        if self._grid is None:
            return image
        pixels = torch.from_numpy(image).permute(2, 0, 1)[None].float()
        moved = torch.nn.functional.grid_sample(
            pixels, self._grid, mode="bilinear", padding_mode="border", align_corners=False
        )
        return moved[0].permute(1, 2, 0).round().to(torch.uint8).numpy()

    def mask(self, mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
        if self._grid is None:
            return mask
        moved = torch.nn.functional.grid_sample(
            torch.from_numpy(mask)[None, None].float(), self._grid, mode="nearest",
            padding_mode="zeros", align_corners=False,
        )  # fmt: skip
        return (moved[0, 0] > 0.5).numpy()

    def pixels(self, xy: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Positions in the frame, pixels; NaN stays NaN."""
        return xy if self._forward is None else self._forward(xy)


def static_cameras(video: VideoFrames, focal: float | None) -> CameraTrack:
    """One camera at the origin for all frames: the world is its frame, y down, z forward.

    Args:
        focal: pixels at the video's own size; None assumes 0.8 of the longer side.
    """
    assumed = ASSUMED_FOCAL * max(video.native_width, video.native_height)
    f = (focal or assumed) * video.width / video.native_width
    K = torch.tensor([[f, 0, video.width / 2], [0, f, video.height / 2], [0, 0, 1]])
    camera = Camera(K, torch.eye(4), video.width, video.height)
    how = "given" if focal else "assumed: 0.8 x the longer side; all depths scale with it"
    provenance = f"static camera at the origin, focal {focal or assumed:.0f} px ({how})"
    none = torch.zeros(0, 3)
    return CameraTrack([camera] * len(video), Undistortion(), none, none, provenance, metric=True)


def colmap_cameras(video: VideoFrames, model: Path) -> CameraTrack:
    """Cameras and points of a COLMAP model, in its own unit, distortion removed.

    Images are matched to frames by the number in their name, which counts video frames from 0
    (or from 1 if no image is numbered 0).

    Raises:
        SourceError: the model is unreadable, lacks frames, or has cameras of several kinds.
    """
    import pycolmap

    try:
        model_read = pycolmap.Reconstruction(str(model))
    except (RuntimeError, ValueError, IndexError) as error:
        raise SourceError(f"{model} is not a readable COLMAP model: {error}") from error
    by_frame = _by_frame(model_read)
    missing = [i for i in video.indices if i not in by_frame]
    if missing:
        shown = ", ".join(map(str, missing[:8])) + (", …" if len(missing) > 8 else "")
        raise SourceError(
            f"camera count unlike frame count: {model} registers {len(by_frame)} images, the video "
            f"gives {len(video)} frames, and {len(missing)} of them have no camera ({shown}); "
            "run COLMAP on all frames, or take fewer (every, max_frames)"
        )
    images = [by_frame[i] for i in video.indices]
    lens = _one_lens(model, model_read, {image.camera_id for image in images})
    K, undistort, shift = _pinhole(lens, video.width, video.height)
    cameras = [_camera(image, K, video) for image in images]
    points = [p for p in model_read.points3D.values() if p.track.length() >= 3]
    if not points:
        raise SourceError(f"{model} has no points seen by three images or more")
    provenance = (
        f"COLMAP {lens.model_name}, {len(images)} of {len(by_frame)} images, "
        f"{len(points)} points, reprojection "
        f"{model_read.compute_mean_reprojection_error():.3f} px, "
        f"distortion up to {shift:.2f} px removed"
    )
    return CameraTrack(
        cameras,
        undistort,
        torch.tensor(np.array([p.xyz for p in points]), dtype=torch.float32),
        torch.tensor(np.array([p.color for p in points]), dtype=torch.float32) / 255,
        provenance,
        metric=False,
    )


def _by_frame(model: Any) -> dict[int, Any]:
    numbered: dict[int, Any] = {}
    for image in model.images.values():
        digits = "".join(c if c.isdigit() else " " for c in Path(image.name).stem).split()
        if not digits:
            raise SourceError(f'COLMAP image "{image.name}" has no frame number in its name')
        if image.has_pose:
            numbered[int(digits[-1])] = image
    if numbered and 0 not in numbered and 1 in numbered:
        return {number - 1: image for number, image in numbered.items()}
    return numbered


def _one_lens(path: Path, model: Any, used: set[int]) -> Any:
    lenses = [model.cameras[i] for i in sorted(used)]
    if any(list(lens.params) != list(lenses[0].params) for lens in lenses):
        raise SourceError(
            f"{path} has {len(lenses)} different cameras; one video has one lens: run COLMAP with "
            "--ImageReader.single_camera 1"
        )
    return lenses[0]


def _pinhole(lens: Any, width: int, height: int) -> tuple[Tensor, Undistortion, float]:
    """Intrinsics at the given size, the distortion's removal, and its largest shift in pixels."""
    scale = np.array([width / lens.width, height / lens.height])
    if abs(scale[0] / scale[1] - 1) > 0.02:
        raise SourceError(
            f"COLMAP saw {lens.width}x{lens.height} images, the frames are {width}x{height}: "
            "another shape"
        )
    focal = np.array([lens.focal_length_x, lens.focal_length_y]) * scale
    center = np.array([lens.principal_point_x, lens.principal_point_y]) * scale
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    pinhole = np.stack((x, y), -1)
    rays = np.concatenate(((pinhole - center) / focal, np.ones((height, width, 1))), -1)
    distorted = np.asarray(lens.img_from_cam(rays.reshape(-1, 3))) * scale
    source = distorted.reshape(height, width, 2)
    shift = float(np.nanmax(np.abs(source - pinhole)))
    K = torch.tensor([[focal[0], 0, center[0]], [0, focal[1], center[1]], [0, 0, 1]]).float()
    if shift < NEGLIGIBLE_SHIFT:
        return K, Undistortion(), 0.0

    def forward(xy: np.ndarray) -> np.ndarray:
        flat = xy.reshape(-1, 2).astype(np.float64)
        known = np.isfinite(flat).all(-1)
        out = np.full_like(flat, np.nan)
        if known.any():
            out[known] = np.asarray(lens.cam_from_img(flat[known] / scale))[:, :2] * focal + center
        return out.reshape(xy.shape).astype(xy.dtype)

    return K, Undistortion(source, forward), shift


def _camera(image: Any, K: Tensor, video: VideoFrames) -> Camera:
    pose = image.cam_from_world()
    w2c = torch.eye(4)
    w2c[:3] = torch.tensor(np.asarray(pose.matrix()), dtype=torch.float32)
    return Camera(K, w2c, video.width, video.height)


def scaled_cameras(cameras: list[Camera], scale: float) -> list[Camera]:
    """The same views of a world made `scale` times larger (metres a COLMAP unit)."""
    scaled = []
    for camera in cameras:
        w2c = camera.world_to_camera.clone()
        w2c[:3, 3] *= scale
        scaled.append(Camera(camera.K, w2c, camera.width, camera.height))
    return scaled


def parallax(cameras: list[Camera], target: Float[Tensor, " 3"]) -> float:
    """Largest angle, degrees, between two views of a point: 0 for a static camera."""
    rays = torch.stack([c.center for c in cameras]) - target
    rays = torch.nn.functional.normalize(rays.double(), dim=-1)
    return float(torch.rad2deg(torch.acos((rays @ rays.mT).clamp(-1, 1)).max()))
