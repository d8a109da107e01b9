"""overlay.mp4: what was prepared, drawn over the frames, to judge it by."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy import ndimage
from torch import Tensor

from hoigs.core.values.camera import Camera
from hoigs.preparation.report.mesh_overlay import overlay_frame
from hoigs.preparation.report.video_out import VideoWriter
from hoigs.preparation.video.resizing import shrink, shrink_mask

HUMAN_COLOR, OBJECT_COLOR, TRACK_COLOR = (64, 220, 120), (255, 210, 40), (255, 60, 200)
SHOWN_POINTS = 150
SEEN, HIDDEN = 0.45, 0.12  # of the body's pixels, as shares of the mix


class OverlayVideo:
    """Frames with the fitted body, the masks' outlines and the object's points.

    Args:
        path: mp4 to write. fps: frames a second.
        width: of the video, pixels, at most the frames'; 0 writes none.
        faces: of the body.
    """

    def __init__(self, path: Path, fps: float | int, width: int, faces: Int[Tensor, "T 3"]) -> None:
        self.width, self.faces = width, faces
        self._video = VideoWriter(path, fps) if width else None

    def __enter__(self) -> OverlayVideo:
        if self._video:
            self._video.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        if self._video:
            self._video.__exit__(kind, error, at)

    def add(
        self,
        image: UInt8[np.ndarray, "H W 3"],
        camera: Camera,
        vertices: Float[Tensor, "V 3"],
        human: Bool[np.ndarray, "H W"],
        object_mask: Bool[np.ndarray, "H W"],
        points: Float[Tensor, "P 3"],
    ) -> None:
        """One frame: vertices of the body and points of the object in the world."""
        if self._video is None:
            return
        width = min(self.width, camera.width)
        small = camera.resized(width, max(1, round(camera.height * width / camera.width)))
        size = (small.width, small.height)
        human, object_mask = shrink_mask(human, *size), shrink_mask(object_mask, *size)
        self._video.add(
            self._draw(shrink(image, *size), small, vertices, human, object_mask, points)
        )

    def _draw(
        self,
        image: UInt8[np.ndarray, "H W 3"],
        camera: Camera,
        vertices: Float[Tensor, "V 3"],
        human: Bool[np.ndarray, "H W"],
        object_mask: Bool[np.ndarray, "H W"],
        points: Float[Tensor, "P 3"],
    ) -> UInt8[np.ndarray, "H W 3"]:
        """The body shaded over the image, faintly where its mask says that it is hidden or not
        there, the masks' outlines and some of the object's points."""
        strength = np.where(human | (not human.any()), SEEN, HIDDEN)
        drawn = overlay_frame(image, camera, vertices, self.faces, strength)
        draw_outline(drawn, human, HUMAN_COLOR)
        draw_outline(drawn, object_mask, OBJECT_COLOR)
        draw_points(drawn, points, camera, TRACK_COLOR)
        return drawn


def several(faces: Int[Tensor, "T 3"], count: int) -> Int[Tensor, "N 3"]:
    """Faces of so many bodies whose vertices follow each other."""
    size = int(faces.max()) + 1
    return torch.cat(
        [torch.zeros(0, 3, dtype=faces.dtype)] + [faces + k * size for k in range(count)]
    )


def draw_outline(
    image: UInt8[np.ndarray, "H W 3"],
    mask: Bool[np.ndarray, "H W"],
    color: tuple[int, int, int],
) -> None:
    """Colours the mask's border pixels, in place."""
    image[mask & ~ndimage.binary_erosion(mask)] = color


def draw_points(
    image: UInt8[np.ndarray, "H W 3"],
    points: Float[Tensor, "P 3"],
    camera: Camera,
    color: tuple[int, int, int],
) -> None:
    """Draws some world points that lie before the camera as 2x2 pixels, in place."""
    xy, depth = camera.project(points[:: max(1, len(points) // SHOWN_POINTS)])
    # single pixels would vanish in the video's halved colour resolution
    for column, row in xy[depth > 0].round().long().tolist():
        if 0 < column <= camera.width and 0 < row <= camera.height:
            image[row - 1 : row + 1, column - 1 : column + 1] = color
