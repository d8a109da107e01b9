"""Cameras of a video: COLMAP's, with the lens distortion taken out, or one that stands still."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.reporting import ranges
from hoigs.core.values.camera import Camera
from hoigs.core.values.lens import Lens, Margins, Undistortion
from hoigs.preparation.video.frames import Frames
from hoigs.preparation.video.source import SourceError, frame_number

CameraKind = Literal["static", "turning", "moving"]
FARTHEST = 1000.0  # times the usual distance: points beyond it are at infinity
ASSUMED_FOCAL = 0.8  # of the longer side: 64 degrees, a phone's main camera


@dataclass(frozen=True)
class CameraTrack:
    """Pinhole cameras of all frames, and the mapping from the video's pixels to theirs.

    Attributes:
        cameras: one a frame, at the size of the frames given out, and `margins` larger.
        points, colors: scene points in the cameras' own unit, RGB in [0, 1]; none if static.
        provenance: for the clip and the report.
        metric: whether the world is in metres already (a static camera has no scale of its own).
        lens: of the video; None if it is a pinhole's.
        margins: pixels at each side by which the images of `cameras` are larger than the frames.
        model: folder of the COLMAP model, or None for a static camera.
        positions: places, among the frames given in, of those that have a camera.
        figures: for the report: "registered" and "images", "reprojection_px", "points",
            "distortion_px", of a static camera "displacement_px" and those of its focal length,
            and of one that turns "turn_degrees".
    """

    cameras: list[Camera]
    points: Float[Tensor, "P 3"]
    colors: Float[Tensor, "P 3"]
    provenance: str
    metric: bool
    lens: Lens | None = None
    model: Path | None = None
    positions: tuple[int, ...] = ()
    figures: dict[str, float] = field(default_factory=dict)
    margins: Margins = (0, 0, 0, 0)

    @property
    def undistort(self) -> Undistortion:
        """From images, masks and pixel positions of the video to those of `cameras`."""
        if self.lens is None:
            return Undistortion()
        left, top, right, bottom = self.margins
        size = (self.cameras[0].width - left - right, self.cameras[0].height - top - bottom)
        return self.lens.undistortion(size, self.margins)

    def with_borders(self) -> CameraTrack:
        """With images that are as much larger as `Lens.margins` says, and so lose no pixels."""
        first = self.cameras[0]
        size = (first.width, first.height)
        margins = (0, 0, 0, 0) if self.lens is None else self.lens.margins(size)
        if not any(margins):
            return self
        left, top, right, bottom = margins
        width, height = first.width + left + right, first.height + top + bottom
        return replace(
            self,
            cameras=[camera.cropped(-left, -top, width, height) for camera in self.cameras],
            margins=margins,
            provenance=f"{self.provenance}, onto {width}x{height} pixels",
        )

    def without(self, frames: Sequence[int]) -> CameraTrack:
        """Without the cameras of some frames, given by their places among those given in."""
        kept = [k for k, place in enumerate(self.positions) if place not in frames]
        cameras, positions = zip(*((self.cameras[k], self.positions[k]) for k in kept), strict=True)
        return replace(self, cameras=[*cameras], positions=positions)

    @property
    def static(self) -> bool:
        """Whether it stays in one place, where it may turn."""
        return not len(self.points)  # only a camera that moves has measured any

    @property
    def kind(self) -> CameraKind:
        """For the report."""
        if not self.static:
            return "moving"
        return "turning" if "turn_degrees" in self.figures else "static"


def pinhole(video: Frames, focal: float) -> Lens:
    """A lens without distortion whose axis meets the middle of the video's frames.

    Args:
        focal: pixels at the video's own size.
    """
    width, height = video.native_width, video.native_height
    return Lens("PINHOLE", (focal, focal, width / 2, height / 2), width, height)


def static_cameras(video: Frames, lens: Lens, how: str = "given") -> CameraTrack:
    """One camera at the origin for all frames: the world is its frame, y down, z forward.

    Args:
        lens: at the video's own size. how: where it comes from, for the provenance.
    """
    K = _intrinsics(lens, video.width, video.height)
    camera = Camera(K, torch.eye(4), video.width, video.height)
    focal = float(lens.K[0, 0])
    shift = lens.undistortion((video.width, video.height)).shift
    removed = f", distortion up to {shift:.2f} px removed" if shift else ""
    provenance = f"static camera at the origin, focal {focal:.0f} px ({how}){removed}"
    none = torch.zeros(0, 3)
    return CameraTrack(
        [camera] * len(video), none, none, provenance, metric=True, lens=lens,
        positions=tuple(range(len(video))),
        figures={"distortion_px": round(shift, 3)} if shift else {},
    )  # fmt: skip


def colmap_cameras(video: Frames, model: Path, *, partial: bool = False) -> CameraTrack:
    """Cameras and points of a COLMAP model, in its own unit, distortion removed.

    Images are matched to frames by the number in their name, which counts video frames from 0
    (or from 1 if no image is numbered 0).

    Args:
        partial: leave out frames that the model has no camera for, or one that lies astray.

    Raises:
        SourceError: the model is unreadable, lacks frames, or has cameras of several kinds.
    """
    from hoigs.core.system.colmap import read_model

    try:
        model_read = read_model(model)
    except (RuntimeError, ValueError, IndexError) as error:
        raise SourceError(f"{model} is not a readable COLMAP model: {error}") from error
    by_frame = _by_frame(model_read)
    if partial:
        by_frame = _without_astray(by_frame)
    missing = [i for i in video.indices if i not in by_frame]
    if missing and (not partial or len(missing) == len(video)):
        raise SourceError(
            f"camera count unlike frame count: {model} registers {len(by_frame)} images, the video "
            f"gives {len(video)} frames, and {len(missing)} of them have no camera "
            f"({ranges(missing)}); run COLMAP on all frames, or take fewer (every, max_frames)"
        )
    positions = tuple(i for i, number in enumerate(video.indices) if number in by_frame)
    images = [by_frame[video.indices[i]] for i in positions]
    lens = _one_lens(model, model_read, {image.camera_id for image in images})
    K = _intrinsics(lens, video.width, video.height)
    shift = lens.undistortion((video.width, video.height)).shift
    cameras = [_camera(image, K, video) for image in images]
    points = [p for p in model_read.points3D.values() if p.track.length() >= 3]
    points = _within_reach(points, torch.stack([camera.center for camera in cameras]).mean(0))
    if not points:
        raise SourceError(f"{model} has no points seen by three images or more")
    off = float(model_read.compute_mean_reprojection_error())
    provenance = (
        f"COLMAP {lens.model}, {len(images)} of {len(by_frame)} images, "
        f"{len(points)} points, reprojection "
        f"{off:.3f} px, "
        f"distortion up to {shift:.2f} px removed"
    )
    return CameraTrack(
        cameras,
        torch.tensor(np.array([p.xyz for p in points]), dtype=torch.float32),
        torch.tensor(np.array([p.color for p in points]), dtype=torch.float32) / 255,
        provenance,
        metric=False,
        lens=lens,
        model=model,
        positions=positions,
        figures={
            "registered": len(images),
            "images": len(video),
            "reprojection_px": round(off, 4),
            "points": len(points),
            "distortion_px": round(shift, 3),
        },
    )


def _within_reach(points: list[Any], middle: Float[Tensor, "3"]) -> list[Any]:
    """Without points that are FARTHEST times as far away as most: their rays are parallel, and how
    far away they are is noise without a bound."""
    away = [float(np.linalg.norm(p.xyz - middle.numpy())) for p in points]
    most = FARTHEST * float(np.median(away)) if away else 0.0
    return [p for p, far in zip(points, away, strict=True) if far <= most]


def _by_frame(model: Any) -> dict[int, Any]:
    numbered: dict[int, Any] = {}
    for image in model.images.values():
        number = frame_number(image.name)
        if number is None:
            raise SourceError(f'COLMAP image "{image.name}" has no frame number in its name')
        if image.has_pose:
            numbered[number] = image
    if numbered and 0 not in numbered and 1 in numbered:
        return {number - 1: image for number, image in numbered.items()}
    return numbered


ASTRAY = 100.0  # median distances of a camera from the middle of all: no path is so uneven


def _without_astray(images: dict[int, Any]) -> dict[int, Any]:
    """Without cameras that COLMAP registered far beyond all others, by a view with hardly any
    points: the motion and depth of everything in such a frame would be as wrong."""
    centers = np.array([image.projection_center() for image in images.values()])
    away = np.linalg.norm(centers - np.median(centers, axis=0), axis=-1)
    near = away <= ASTRAY * max(float(np.median(away)), np.finfo(float).tiny)
    return {number: image for (number, image), kept in zip(images.items(), near) if kept}


def _one_lens(path: Path, model: Any, used: set[int]) -> Lens:
    lenses = [model.cameras[i] for i in sorted(used)]
    if any(list(lens.params) != list(lenses[0].params) for lens in lenses):
        raise SourceError(
            f"{path} has {len(lenses)} different cameras; one video has one lens: run COLMAP with "
            "--ImageReader.single_camera 1"
        )
    first = lenses[0]
    return Lens(first.model_name, tuple(map(float, first.params)), first.width, first.height)


def _intrinsics(lens: Lens, width: int, height: int) -> Float[Tensor, "3 3"]:
    """Of the pinhole camera at the given size.

    Raises:
        SourceError: the lens saw images of another shape.
    """
    scale = torch.tensor([[width / lens.width], [height / lens.height], [1.0]], dtype=torch.float64)
    if abs(float(scale[0] / scale[1]) - 1) > 0.02:
        raise SourceError(
            f"the lens is of {lens.width}x{lens.height} images, the frames are {width}x{height}: "
            "another shape"
        )
    return (lens.K * scale).float()


def _camera(image: Any, K: Tensor, video: Frames) -> Camera:
    pose = image.cam_from_world()
    w2c = torch.eye(4)
    w2c[:3] = torch.tensor(np.asarray(pose.matrix()), dtype=torch.float32)
    return Camera(K, w2c, video.width, video.height)


def parallax(cameras: list[Camera], target: Float[Tensor, " 3"]) -> float:
    """Largest angle, degrees, between two views of a point: 0 for a static camera."""
    rays = torch.stack([c.center for c in cameras]) - target
    rays = torch.nn.functional.normalize(rays.double(), dim=-1)
    least = min(float((some @ rays.mT).min()) for some in rays.split(256))  # not F times F at once
    return math.degrees(math.acos(min(max(least, -1.0), 1.0)))


STILL = 1e-4  # metres a frame: what moves less stands still


def angular_factor(cameras: Sequence[Camera], target: Float[Tensor, "F 3"], fps: float) -> float:
    """omega: how fast the camera goes round what moves, degrees a second; 0 for a static camera.

    The mean over frames of the angle between two successive views, times the frame rate. DyCheck
    takes the point that all optical axes pass; here it is `target`, the person in each frame.
    """
    if len(cameras) < 2:
        return 0.0
    centers = torch.stack([c.center for c in cameras]).double()
    middle = 0.5 * (target[1:] + target[:-1]).double()
    before, after = centers[:-1] - middle, centers[1:] - middle
    # atan2, because the cosine of a small angle has lost it
    angle = torch.atan2(torch.linalg.cross(before, after).norm(dim=-1), (before * after).sum(-1))
    return float(torch.rad2deg(angle.mean()) * fps)


def full_factor(cameras: Sequence[Camera], points: Float[Tensor, "F P 3"]) -> float | None:
    """Omega: how much faster the camera moves than what it looks at; None if nothing moves.

    |o_t+1 - o_t| over |x_t+1 - x_t|, the mean over points that move, the median over
    frames (DyCheck takes the mean, which moments of rest make infinite).
    """
    if len(cameras) < 2:
        return None
    centers = torch.stack([c.center for c in cameras])
    camera = (centers[1:] - centers[:-1]).norm(dim=-1)
    scene = (points[1:] - points[:-1]).norm(dim=-1).mean(-1)
    moving = scene > STILL
    return float((camera[moving] / scene[moving]).median()) if moving.any() else None
