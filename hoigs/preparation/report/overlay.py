"""overlay.mp4: what was prepared, drawn over the frames, to judge it by."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from PIL import Image, ImageDraw
from scipy import ndimage
from torch import Tensor

from hoigs.core.system.video_files import coded, declare_colors, pyav
from hoigs.core.values.camera import Camera
from hoigs.preparation.video.pictures import shrink, shrink_mask

# A shaded mesh over a picture, by the painter's algorithm: enough to judge a fit.

TINT = np.array((90, 200, 255))


def overlay_frame(
    image: UInt8[np.ndarray, "H W 3"],
    camera: Camera,
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    strength: float | Float[np.ndarray, "H W"] = 0.6,
) -> UInt8[np.ndarray, "H W 3"]:
    """`image` with a mesh blended over it.

    Args:
        vertices: world, metres. strength: 0 shows only the image, 1 only the mesh; of all pixels
            or of each.
    """
    strength = np.asarray(strength)[..., None]
    with torch.no_grad():
        pixels, depth = camera.project(vertices)
        corners = pixels[faces]
        a, b, c = corners.unbind(1)
        turn = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
        cam = camera.to_camera(vertices)[faces]
        normals = torch.linalg.cross(cam[:, 1] - cam[:, 0], cam[:, 2] - cam[:, 0])
        normals = torch.nn.functional.normalize(normals, dim=-1)
        toward = (normals * torch.nn.functional.normalize(cam.mean(1), dim=-1)).sum(-1)
        middle = depth[faces].mean(1)
        shown = (depth[faces] > 0.05).all(1) & (toward < 0) & (turn.abs() > 1e-6)
        order = middle[shown].argsort(descending=True)
        polygons = corners[shown][order].flatten(1).tolist()
        shade = (0.35 + 0.65 * -toward[shown][order]).clamp(0, 1).numpy()
    layer = Image.fromarray(image)
    draw = ImageDraw.Draw(layer)
    for polygon, light in zip(polygons, shade, strict=True):
        draw.polygon(polygon, fill=tuple((TINT * light).astype(int)))
    mixed = strength * np.asarray(layer, float) + (1 - strength) * image
    return mixed.round().astype(np.uint8)


# RGB frames to an mp4 that browsers play.


class VideoWriter:
    """H.264, yuv420p; an odd last row or column is dropped, as the format demands.

    >>> with VideoWriter("overlay.mp4", fps=24) as video:
    ...     video.add(image)

    Args:
        path: to write. fps: frames a second. crf: quality, lower is better (18 is near lossless).
    """

    def __init__(self, path: str | Path, fps: float | int, crf: int = 23) -> None:
        self.path, self.fps, self.crf = Path(path), fps, crf
        self._stream: Any = None

    def __enter__(self) -> VideoWriter:
        av = pyav()

        self._container = av.open(str(self.path), "w")
        return self

    def add(self, image: UInt8[np.ndarray, "H W 3"]) -> None:
        height, width = (n - n % 2 for n in image.shape[:2])
        if self._stream is None:
            rate = Fraction(self.fps).limit_denominator(1000)
            self._stream = self._container.add_stream("libx264", rate=rate)
            self._stream.width, self._stream.height = width, height
            self._stream.pix_fmt = "yuv420p"
            self._stream.options = {"crf": str(self.crf), "preset": "veryfast"}
            declare_colors(self._stream)
        frame = coded(np.ascontiguousarray(image[:height, :width]), self._stream)
        self._container.mux(self._stream.encode(frame))

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        if self._stream is not None and kind is None:
            self._container.mux(self._stream.encode())
        self._container.close()


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


# object.jpg: the object as it was taken to be, in one frame, so that a wrong choice is seen.


NAME, LONGEST, DIM = "object.jpg", 960, 0.45


def shown_frame(numbers: Sequence[int], boxes: Sequence[Sequence[float]], prompted: Sequence[int],
                coverage: Sequence[float]) -> int:  # fmt: skip
    """Position among the chosen frames `numbers` of the one to show: where the object was proposed
    or prompted, if its mask is there, else where its mask is largest."""
    for number in [int(box[0]) for box in boxes] + list(prompted):
        nearest = int(np.abs(np.asarray(numbers) - number).argmin())
        if coverage[nearest] > 0:
            return nearest
    return int(np.argmax(coverage))


def save_object_picture(
    folder: Path, image: UInt8[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"]
) -> None:
    """The frame with everything but the object dimmed, and its outline."""
    width = max(1, round(max(image.shape) / 400))
    border = ndimage.binary_dilation(mask, iterations=width) & ~mask
    shown = np.where(mask[..., None], image, (DIM * image).astype(np.uint8))
    shown[border] = OBJECT_COLOR
    picture = Image.fromarray(shown)
    picture.thumbnail((LONGEST, LONGEST))
    picture.save(folder / NAME, quality=88)
