"""What checks share: components by key, and a small clip of a speckled wall with its depth."""

from __future__ import annotations

import math
from typing import Any

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from hoigs.core.interfaces.context import BuildContext
from hoigs.core.registry.registry import default_registry
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip, FrameStore
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment

SIZE = 48
AWAY = 4.0  # metres from the camera to the wall


def component(key: str, **settings: Any) -> Any:
    """A component of hoigs by its key, with these settings and no clip."""
    registry = default_registry()
    config = registry.config_class(key).model_validate(settings)
    return registry.concrete(key).from_config(config, BuildContext())


class Pictures(FrameStore):
    """Frames in memory, without masks."""

    def __init__(self, images: list[Tensor], depths: list[Tensor]) -> None:
        self.images, self.depths = images, depths

    def image(self, position: int) -> UInt8[Tensor, "H W 3"]:
        return self.images[position]

    def mask(self, entity: str, position: int) -> Bool[Tensor, "H W"]:
        raise KeyError(entity)

    def depth(self, position: int) -> Float[Tensor, "H W"] | None:
        return self.depths[position]


def wall(count: int = 300) -> Gaussians:
    """Gaussians of random colours on the plane z = 0."""
    generator = torch.Generator().manual_seed(1)
    points = 3.2 * (torch.rand(count, 3, generator=generator) - 0.5)
    points[:, 2] = 0.0
    colors = torch.rand(count, 3, generator=generator)
    return Gaussians.from_points(points, colors, scales=0.1, opacity=0.9)


def cameras(frames: int, arc: float) -> list[Camera]:
    """Cameras on an arc of `arc` radians about the middle of the wall; 0 is a static camera."""
    found = []
    for i in range(frames):
        angle = arc * (i / max(1, frames - 1) - 0.5)
        eye = AWAY * torch.tensor([math.sin(angle), 0.0, -math.cos(angle)])
        found.append(Camera.look_at(eye, torch.zeros(3), width=SIZE, height=SIZE, fov_y=0.6))
    return found


@torch.no_grad()
def toy_clip(frames: int = 4, arc: float = 0.4, depth_scale: float = 1.0) -> Clip:
    """A clip of training frames only, whose depth is the true depth times `depth_scale`."""
    scene, views = wall(), cameras(frames, arc)
    images, depths = [], []
    for camera in views:
        color = component("rasterizer:torch").render(scene, camera).color
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
        points=points,
        point_colors=torch.full((len(points), 3), 0.5),
        split={"train": list(range(frames)), "test": []},
        depth_kind="metric",
    )
