"""The person: landmarks in the frames' pixels, the body fitted to them, and what follows."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hoigs.core.interfaces.body import PELVIS, BodyModel
from hoigs.core.values.camera import Camera
from hoigs.core.values.moment import BodyPose
from hoigs.preparation.body.fit import fit_body
from hoigs.preparation.body.fit_problem import FitOptions
from hoigs.preparation.body.landmarks import LandmarkTrack
from hoigs.preparation.body.silhouette import posed
from hoigs.preparation.cameras.camera_track import CameraTrack
from hoigs.preparation.masks.mask_stack import MaskStack
from hoigs.preparation.video.frames import Frames
from hoigs.preparation.video.source import SourceError

POOR_FIT = 0.02  # of the image's longer side: a fit that misses by more deserves a warning


@dataclass(frozen=True)
class FittedBody:
    """A body in the world, metres.

    Attributes:
        poses: batched over the frames. joints: world.
        scene_scale: metres a unit of the cameras' own world.
        residual_px: mean distance of visible landmarks, median over frames, pixels of the frames.
        residuals: of each frame, NaN without landmarks.
        ground: largest y of the body, median over frames: the floor's height, if y points down.
        found: frames with landmarks; the body of the others is interpolated.
        report: measures of the fit.
    """

    poses: BodyPose
    joints: Float[Tensor, "F J 3"]
    scene_scale: float
    residual_px: float
    residuals: Float[Tensor, " F"]
    ground: float
    found: Bool[np.ndarray, " F"]
    provenance: str
    report: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def posed(self, body: BodyModel) -> Iterator[tuple[Tensor, Tensor]]:
        """Vertices and joints, frame by frame."""
        return posed(body, self.poses)

    def distance(self, cameras: Sequence[Camera]) -> float:
        """Median depth of the pelvis, metres."""
        depths = [c.to_camera(p)[2] for c, p in zip(cameras, self.joints[:, PELVIS], strict=True)]
        return float(torch.stack(depths).median())


@dataclass(frozen=True)
class RawLandmarks:
    """Landmarks of the chosen frames, distortion still in; NaN where they were not found.

    Attributes:
        image: x, y, relative depth (pixels of the frames) and visibility. world: metres about the
            hips' middle, and visibility; NaN if the estimator sees the image only.
        source: for the report.
    """

    image: Float[np.ndarray, "F 33 4"]
    world: Float[np.ndarray, "F 33 4"]
    source: str = "MediaPipe"

    def undistorted(self, track: CameraTrack) -> LandmarkTrack:
        """On the cameras' undistorted images, without the frames that have no camera."""
        rows = list(track.positions)
        image = self.image[rows].copy()
        image[..., :2] = track.undistort.pixels(image[..., :2])
        return LandmarkTrack.from_mediapipe(image, self.world[rows])


def chosen_landmarks(
    image: Float[np.ndarray, "T 33 4"],
    world: Float[np.ndarray, "T 33 4"] | None,
    video: Frames,
    what: str,
    source: str = "MediaPipe",
) -> RawLandmarks:
    """Landmarks of a whole video, in its own pixels, as those of the chosen frames.

    Args:
        world: None if the estimator sees the image only.

    Raises:
        SourceError: no person is found in them; `what` names where they come from.
    """
    image = image[video.indices].astype(np.float64)
    image[..., :3] *= video.width / video.native_width
    if world is None:
        places = np.full_like(image, np.nan)
    else:
        places = world[video.indices].astype(np.float64)
    raw = RawLandmarks(image, places, source)
    if not LandmarkTrack.from_mediapipe(raw.image, raw.world).found.any():
        raise SourceError(f"{what}: no person was found in the {len(image)} chosen frames")
    return raw


def fit_person(
    landmarks: LandmarkTrack,
    track: CameraTrack,
    body: BodyModel,
    steps: int,
    progress: Callable[[float], None] | None = None,
    source: str = "MediaPipe",
    masks: MaskStack | None = None,
) -> FittedBody:
    """Fits the body to landmarks, and masks if there are any, in `steps`; finds the scale of a
    world that has none."""
    options = FitOptions(scale=not track.metric, steps=steps)
    known = None if track.metric else track.points
    fit = fit_body(
        body, landmarks, track.cameras,
        options=options, points=known, masks=masks, progress=progress,
    )  # fmt: skip
    frames = list(posed(body, fit.poses))
    residual = float(fit.residual_px.nanmedian())
    found, solid = int(landmarks.found.sum()), int(landmarks.solid.sum())
    return FittedBody(
        poses=fit.poses,
        joints=torch.stack([joints for _, joints in frames]),
        scene_scale=fit.scene_scale,
        residual_px=residual,
        residuals=fit.residual_px,
        ground=float(torch.stack([vertices[:, 1].max() for vertices, _ in frames]).median()),
        found=landmarks.found.numpy(),
        provenance=(
            f"fitted to {source} landmarks{'' if solid else ' in the image only'} of {found} of "
            f"{len(track.cameras)} frames{'' if masks is None else ' and to masks'}, "
            f"{residual:.1f} px off (median of frames); hands are not fitted"
        ),
        report=fit.report,
        warnings=_warnings(residual, found, solid, track.cameras),
    )


def _warnings(residual: float, found: int, solid: int, cameras: Sequence[Camera]) -> list[str]:
    warnings = []
    if solid < found:
        warnings.append(
            f"landmarks of {found - solid} of {found} frames are known in the image only: the "
            "depth of limbs is a guess there (estimator:mediapipe sees it)"
        )
    if residual > POOR_FIT * max(cameras[0].width, cameras[0].height):
        warnings.append(f"the body misses its landmarks by {residual:.1f} px: see overlay.mp4")
    if found < 0.8 * len(cameras):
        warnings.append(
            f"landmarks were found in {found} of {len(cameras)} frames; the "
            "others follow their neighbours, and masks where there are any"
        )
    return warnings
