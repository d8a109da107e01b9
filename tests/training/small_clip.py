"""A clip of 64x64 pixels drawn from known Gaussians, and models that do not know them yet."""

from __future__ import annotations

import math

import torch
from recorded import Recorded

from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.rasterizers.torch_tiles import TorchRasterizer

SIZE, FRAMES = 64, 6


def truth(count: int = 220) -> Gaussians:
    """A bumpy sheet of small coloured spots."""
    generator = torch.Generator().manual_seed(1)
    points = torch.rand(count, 3, generator=generator) * torch.tensor([2.0, 2.0, 0.4]) - 1.0
    colors = torch.rand(count, 3, generator=generator)
    return Gaussians.from_points(points, colors, scales=0.09, opacity=0.9)


def small_clip() -> Clip:
    """Six views along an arc, all for training; its points are few and away from the truth."""
    scene, images, cameras = truth(), [], []
    for i in range(FRAMES):
        angle = 0.5 * (i / (FRAMES - 1) - 0.5)
        eye = torch.tensor([4 * math.sin(angle), 0.2, -4 * math.cos(angle)])
        target = torch.tensor([0.0, 0.0, -0.8])
        cameras.append(Camera.look_at(eye, target, width=SIZE, height=SIZE, fov_y=0.7))
        with torch.no_grad():
            color = TorchRasterizer().render(scene, cameras[-1]).color
        images.append((255 * color.clamp(0, 1)).round().to(torch.uint8))
    generator = torch.Generator().manual_seed(2)
    rows = torch.randperm(len(scene), generator=generator)[:60]
    points = scene.means[rows] + 0.05 * torch.randn(60, 3, generator=generator)
    return Clip(
        "small",
        Recorded(images),
        cameras,
        [Moment(i / (FRAMES - 1), i) for i in range(FRAMES)],
        points=points,
        point_colors=torch.full((60, 3), 0.5),
        split={"train": list(range(FRAMES)), "test": []},
    )
