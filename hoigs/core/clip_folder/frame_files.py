"""FrameFiles writes what a clip folder has of each frame: image, masks, depth, and the cameras."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from torch import Tensor

from hoigs.core.clip_folder.format import depth_path, ignored_path, mask_path, stem
from hoigs.core.errors import ClipError
from hoigs.core.values.camera import Camera

Image8 = UInt8[Tensor, "H W 3"] | UInt8[np.ndarray, "H W 3"]
Mask = Bool[Tensor, "H W"] | Bool[np.ndarray, "H W"]
Depth = Float[Tensor, "H W"] | Float[np.ndarray, "H W"]
ImageFormat = Literal["png", "jpg"]


def as_array(values: Any, dtype: type = np.float32) -> np.ndarray:
    """Values of a tensor on any device, or of an array, for a file."""
    if isinstance(values, Tensor):
        values = values.detach().cpu().numpy()
    return np.asarray(values, dtype=dtype)


def _save_mask(path: Path, mask: Mask) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(as_array(mask, np.bool_).astype(np.uint8) * 255).save(path, compress_level=3)


class FrameFiles:
    """The frames of the clip itself, or of its held_out folder.

    Attributes:
        cameras: of the frames written so far. size: width and height of all, pixels.
    """

    def __init__(self, root: Path, image_format: ImageFormat, quality: int) -> None:
        self.root, self.image_format, self.quality = root, image_format, quality
        self.cameras: list[Camera] = []
        self.size: tuple[int, int] | None = None

    def add(
        self,
        image: Image8,
        camera: Camera,
        masks: Mapping[str, Mask],
        depth: Depth | None,
        depth_dtype: type,
        ignored: Mask | None = None,
    ) -> int:
        frame = len(self.cameras)
        pixels = as_array(image, np.uint8)
        height, width = pixels.shape[:2]
        self.size = self.size or (width, height)
        if (width, height) != self.size or (camera.width, camera.height) != self.size:
            raise ClipError(
                f"frame {frame}: image is {width}x{height} and its camera "
                f"{camera.width}x{camera.height}, but the clip is {self.size[0]}x{self.size[1]}"
            )
        self._save_image(pixels, frame)
        for name, mask in masks.items():
            _save_mask(mask_path(self.root, name, frame), mask)
        if ignored is not None and as_array(ignored, np.bool_).any():
            _save_mask(ignored_path(self.root, frame), ignored)
        if depth is not None:
            path = depth_path(self.root, frame)
            path.parent.mkdir(parents=True, exist_ok=True)
            np.savez_compressed(path, depth=as_array(depth, depth_dtype))
        self.cameras.append(camera)
        return frame

    def _save_image(self, pixels: np.ndarray, frame: int) -> None:
        folder = self.root / "images"
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{stem(frame)}.{self.image_format}"
        if self.image_format == "jpg":
            # 4:4:4: chroma subsampling would smear the borders that masks cut along
            Image.fromarray(pixels).save(path, quality=self.quality, subsampling=0)
        else:
            Image.fromarray(pixels).save(path, compress_level=3)

    def save_cameras(self) -> None:
        np.savez_compressed(
            self.root / "cameras.npz",
            K=np.stack([as_array(c.K) for c in self.cameras]),
            world_to_camera=np.stack([as_array(c.world_to_camera) for c in self.cameras]),
        )
