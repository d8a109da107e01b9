"""A clip of a few small pictures drawn from known Gaussians: a speckled wall, and its depth."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from hoigs.core.camera import Camera
from hoigs.core.clip import Clip, FrameStore
from hoigs.core.gaussians import Gaussians
from hoigs.core.moment import Moment
from hoigs.rasterizers.torch_tiles import TorchRasterizer

SIZE = 48
AWAY = 4.0  # metres from the camera to the wall


class Pictures(FrameStore):
    """Frames in memory. depths may hold anything, NaN too."""

    def __init__(self, images: list[Tensor], depths: list[Tensor]) -> None:
        self.images, self.depths = images, depths

    def image(self, position: int) -> UInt8[Tensor, "H W 3"]:
        return self.images[position]

    def mask(self, entity: str, position: int) -> Bool[Tensor, "H W"]:
        raise KeyError(entity)

    def depth(self, position: int) -> Float[Tensor, "H W"] | None:
        return self.depths[position]


def wall(count: int = 300) -> Gaussians:
    """Coloured spots on the plane z = 0."""
    generator = torch.Generator().manual_seed(1)
    points = 3.2 * (torch.rand(count, 3, generator=generator) - 0.5)
    points[:, 2] = 0.0
    colors = torch.rand(count, 3, generator=generator)
    return Gaussians.from_points(points, colors, scales=0.1, opacity=0.9)


def cameras(frames: int, arc: float) -> list[Camera]:
    """On an arc of so many radians about the wall's middle; 0 stands still."""
    found = []
    for i in range(frames):
        angle = arc * (i / max(1, frames - 1) - 0.5)
        eye = AWAY * torch.tensor([math.sin(angle), 0.0, -math.cos(angle)])
        found.append(Camera.look_at(eye, torch.zeros(3), width=SIZE, height=SIZE, fov_y=0.6))
    return found


@torch.no_grad()
def toy_clip(frames: int = 4, arc: float = 0.4, depth_scale: float = 1.0) -> Clip:
    """All frames are for training; the depth is the wall's times `depth_scale`."""
    scene, views = wall(), cameras(frames, arc)
    images, depths = [], []
    for camera in views:
        color = TorchRasterizer().render(scene, camera).color
        images.append((255 * color.clamp(0, 1)).round().to(torch.uint8))
        grid = camera.pixel_grid()
        ones = torch.ones(grid.shape[:2])
        near, far = camera.unproject(grid, ones), camera.unproject(grid, 2 * ones)
        # where the ray through a pixel meets z = 0
        depths.append((1 - near[..., 2] / (far - near)[..., 2]) * depth_scale)
    generator = torch.Generator().manual_seed(2)
    points = 3.2 * (torch.rand(2000, 3, generator=generator) - 0.5)
    points[:, 2] = 0.0
    return Clip(
        "toy",
        Pictures(images, depths),
        views,
        [Moment(i / max(1, frames - 1), i) for i in range(frames)],
        kinds={},
        bodies={},
        objects={},
        points=points,
        point_colors=torch.full((len(points), 3), 0.5),
        split={"train": list(range(frames)), "test": []},
        depth_kind="metric",
    )
