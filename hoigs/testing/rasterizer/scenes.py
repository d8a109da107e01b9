"""Small scenes for rasterizers, made on the CPU in float32, the same on every machine."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field, fields
from typing import Any, TypeVar

import torch
from torch import Tensor

from hoigs.core.interfaces.rasterizer import RenderOutput, RenderRequest
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians

Value = TypeVar("Value")
RAW = tuple(f.name for f in fields(Gaussians))


@dataclass(frozen=True, eq=False)
class Scene:
    """What `Rasterizer.render` takes."""

    gaussians: Gaussians
    camera: Camera
    request: RenderRequest = field(default_factory=RenderRequest)

    def __len__(self) -> int:
        return len(self.gaussians)


def random_gaussians(count: int = 150, *, degree: int = 3, seed: int = 0) -> Gaussians:
    """Random Gaussians around the origin, one to ten pixels large in `a_camera`."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    return Gaussians(
        means=normal(count, 3) * 0.8,
        quats=normal(count, 4),
        log_scales=normal(count, 3) * 0.6 - 2.2,
        opacity_logits=normal(count),
        sh=normal(count, (degree + 1) ** 2, 3) * 0.3,
    )


def random_scene(
    count: int = 150, *, degree: int = 3, seed: int = 0, channels: int = 4, offset: float = 0.5
) -> Scene:
    """`random_gaussians` before `a_camera`, with every tensor that a request can hold.

    Args:
        channels: of the features.
        offset: standard deviation of the screen offsets, pixels.
    """
    generator = torch.Generator().manual_seed(seed + 100)
    camera = a_camera()
    request = RenderRequest(
        features=torch.randn(count, channels, generator=generator),
        screen_offsets=torch.randn(count, 2, generator=generator) * offset,
        background=torch.rand(camera.height, camera.width, 3, generator=generator),
    )
    return Scene(random_gaussians(count, degree=degree, seed=seed), camera, request)


def a_camera(width: int = 44, height: int = 30) -> Camera:
    """Turned about every axis, unequal focal lengths, principal point off the middle."""
    camera = Camera.look_at(
        torch.tensor([1.0, -0.7, -3.0]),
        torch.tensor([0.1, 0.05, 0.0]),
        width=width,
        height=height,
        fov_y=0.9,
        up=(0.2, 1.0, 0.1),
    )
    K = camera.K * torch.tensor([[1.1], [0.95], [1.0]])
    K[:2, 2] = torch.tensor([0.43 * width, 0.58 * height])
    return Camera(K, camera.world_to_camera, width, height)


def front_camera(
    width: int = 21, height: int = 15, focal: float = 20.0, *, cx: float = 10.5, cy: float = 7.5
) -> Camera:
    """At the origin, along +z."""
    K = torch.tensor([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])
    return Camera(K, torch.eye(4), width, height)


def one_gaussian(
    mean: tuple[float, float, float] = (0.0, 0.0, 2.0),
    *,
    scale: float = 0.2,
    opacity: float = 0.6,
    color: tuple[float, float, float] = (0.9, 0.4, 0.1),
) -> Gaussians:
    point, rgb = (torch.tensor([x], dtype=torch.float32) for x in (mean, color))
    return Gaussians.from_points(point, rgb, scales=scale, opacity=opacity)


def images(output: RenderOutput) -> dict[str, Tensor]:
    """The pictures of an output by name; features only where there are some."""
    found = {"color": output.color, "alpha": output.alpha, "depth": output.depth}
    if output.features is not None:
        found["features"] = output.features
    return found


def on(device: torch.device, value: Value) -> Value:
    """Gaussians, a Camera or a RenderRequest, moved."""
    moved = {
        f.name: v.to(device)
        for f in fields(value)  # type: ignore[arg-type]
        if isinstance(v := getattr(value, f.name), Tensor)
    }
    return forged(value, **moved)


def forged(value: Value, **changes: Any) -> Value:
    """A copy of a frozen dataclass with fields replaced, without its own checks."""
    result = copy.copy(value)
    for name, change in changes.items():
        object.__setattr__(result, name, change)
    return result
