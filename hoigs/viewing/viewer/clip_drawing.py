"""ClipDrawing: a prepared clip, drawn as its own frames with masks or depth over them."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8

from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip
from hoigs.evaluation.report.media import false_color
from hoigs.viewing.viewer.panes import nearest_position, placed
from hoigs.viewing.viewer.run_drawing import Look, Picture, entity_colors

TINT = 0.5  # share of a mask's colour over the frame


class ClipDrawing:
    """Draws the frames of a clip from the video's own camera, which is the only one they have."""

    modes = ("frame and masks", "frame", "depth")
    anywhere = False  # only from the camera of the video
    has_interaction = False

    def __init__(self, clip: Clip) -> None:
        self.clip = clip
        self.names = list(clip.kinds)
        self.title = f"**{clip.name}**, {len(clip)} frames"
        self._span: tuple[float, float] | None = None

    def draw(self, frame: float, camera: Camera, look: Look, depth: bool = False) -> Picture:
        """The nearest frame of the video in a picture of the camera's size; it has no depth."""
        position = nearest_position(self.clip, frame)
        image = self._depth(position) if look.mode == "depth" else self._frame(position, look)
        return Picture(placed(image, (camera.width, camera.height)))

    def _frame(self, position: int, look: Look) -> UInt8[np.ndarray, "H W 3"]:
        image = self.clip.store.image(position).numpy()
        if look.mode == "frame":
            return image
        mixed = image.astype(np.float32)
        colors = entity_colors(self.names)
        for name in self.names:
            if name in look.entities:
                mask = self.clip.store.mask(name, position).numpy()
                mixed[mask] += TINT * (np.array(colors[name], np.float32) * 255 - mixed[mask])
        return np.rint(mixed).astype(np.uint8)

    def _depth(self, position: int) -> UInt8[np.ndarray, "H W 3"]:
        """False colour, near is bright; black where it is unknown."""
        depth = self.clip.store.depth(position)
        if depth is None:
            return np.zeros_like(self.clip.store.image(position).numpy())
        known = depth > 0
        if self._span is None and bool(known.any()):
            near, far = np.quantile(depth[known].numpy(), (0.02, 0.98))
            self._span = float(near), max(float(far), float(near) + 1e-3)
        near, far = self._span or (0.0, 1.0)
        image = false_color(0.1 + 0.9 * ((far - depth) / (far - near)).clamp(0, 1), "magma")
        image[~known.numpy()] = 0
        return image
