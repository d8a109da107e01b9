"""exporter:rgba: entities drawn from the camera of the video with transparency, for compositing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from jaxtyping import UInt8
from pydantic import Field

from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.rasterizer import RenderOutput
from hoigs.core.model.exporter import Exporter, ExportRequest
from hoigs.core.reporting import Progress
from hoigs.core.system.video_files import write_video
from hoigs.core.values.between import camera_between, frame_of

SUFFIXES = {"prores": ".mov", "vp9": ".webm", "png": ".zip"}


class RgbaConfig(ComponentConfig):
    """Settings of `exporter:rgba`."""

    codec: Literal["prores", "vp9", "png"] = "prores"
    """ProRes 4444 (.mov, for editing), VP9 (.webm, for browsers), or a PNG for each moment"""
    width: int | None = Field(default=None, ge=16)
    """pixels; by default that of the clip as it was trained"""


class RgbaExporter(Exporter):
    """`rgba.mov`, `rgba.webm` or `frame_0000.png` …: straight alpha, 8 bits or more."""

    Config: ClassVar[type[ComponentConfig]] = RgbaConfig
    units = "pixels"
    axes = "images from the camera of the video"
    keeps: ClassVar = {"colour": "straight (not premultiplied), sRGB", "alpha": "opacity"}

    def __init__(self, config: RgbaConfig | None = None) -> None:
        self.config = config or RgbaConfig()
        suffix = SUFFIXES[self.config.codec]
        self.suffixes = () if suffix == ".zip" else (suffix,)

    def write(self, request: ExportRequest, folder: Path, progress: Progress) -> Mapping[str, str]:
        """See `Exporter.write`."""
        lost = {"depth": "pictures have none; ply-sequence holds the Gaussians"}
        images = self._images(request, progress)
        if self.config.codec == "png":
            from PIL import Image

            for i, image in enumerate(images):
                Image.fromarray(image).save(folder / f"frame_{i:04d}.png")
            return lost
        write_video(folder / f"rgba{self.suffixes[0]}", images, fps=request.fps)
        return lost | {"exact colours": "the video is compressed; png keeps them"}

    def _images(
        self, request: ExportRequest, progress: Progress
    ) -> Iterator[UInt8[np.ndarray, "H W 4"]]:
        for i, moment in enumerate(request.moments):
            progress(i / len(request.moments), f"moment {i + 1} of {len(request.moments)}")
            camera = camera_between(request.clip, frame_of(request.clip, moment))
            if self.config.width is not None:
                height = round(camera.height * self.config.width / camera.width)
                camera = camera.resized(self.config.width, height)
            drawn = request.scene.render(
                moment, camera.to(request.scene.device), only=request.entities
            )
            yield straight_rgba(drawn)


def straight_rgba(drawn: RenderOutput) -> UInt8[np.ndarray, "H W 4"]:
    """A picture over black as colours and opacities of its own."""
    alpha = drawn.alpha.clamp(0, 1)
    color = (drawn.color / alpha.clamp_min(1e-4)[..., None]).clamp(0, 1)
    color = color * (alpha > 0)[..., None]
    rgba = np.concatenate((color.cpu().numpy(), alpha.cpu().numpy()[..., None]), -1)
    image: np.ndarray = np.round(rgba * 255).astype(np.uint8)
    return image
