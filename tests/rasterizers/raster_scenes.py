"""Scenes, and the comparisons that every backend must pass."""

from __future__ import annotations

import copy
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import torch
from torch import Tensor

from hoigs.core.camera import Camera
from hoigs.core.gaussians import Gaussians
from hoigs.core.rasterizer import Rasterizer, RenderOutput, RenderRequest
from hoigs.rasterizers.oracle import OracleRasterizer

Value = TypeVar("Value")
CUT = OracleRasterizer(cutoffs=True)
RAW = ("means", "quats", "log_scales", "opacity_logits", "sh")


@dataclass(frozen=True)
class Backend:
    rasterizer: Rasterizer
    device: torch.device

    def render(
        self, gaussians: Gaussians, camera: Camera, request: RenderRequest | None = None
    ) -> RenderOutput:
        """Draw on the backend's device what was made on the CPU."""
        request = None if request is None else on(self.device, request)
        return self.rasterizer.render(on(self.device, gaussians), on(self.device, camera), request)


def random_scene(count: int = 150, *, degree: int = 3, seed: int = 0) -> Gaussians:
    """A cloud around the origin, splats of one to ten pixels, as `a_camera` sees it."""
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


def on(device: torch.device, value: Value) -> Value:
    """Gaussians, a Camera or a RenderRequest, moved."""
    moved = {
        f.name: v.to(device)
        for f in fields(value)  # type: ignore[arg-type]
        if isinstance(v := getattr(value, f.name), Tensor)
    }
    return forged(value, **moved)


def forged(value: Value, **changes: Any) -> Value:
    """A frozen dataclass with fields replaced behind the back of its own checks."""
    result = copy.copy(value)
    for name, change in changes.items():
        object.__setattr__(result, name, change)
    return result


def images(output: RenderOutput) -> dict[str, Tensor]:
    found = {"color": output.color, "alpha": output.alpha, "depth": output.depth}
    if output.features is not None:
        found["features"] = output.features
    return found


def clear_of_cutoffs(gaussians: Gaussians, camera: Camera, request: RenderRequest) -> Tensor:
    """Pixels [H, W] where a small change of the two cut-offs changes nothing.

    Elsewhere one splat more or less may be drawn by rounding alone.
    """
    base = CUT.render(gaussians, camera, request)
    clear = torch.ones_like(base.alpha, dtype=torch.bool)
    for factor in (0.999, 1.001):
        for name in ("min_alpha", "min_transmittance"):
            moved = request.replace(**{name: getattr(request, name) * factor})
            clear &= (CUT.render(gaussians, camera, moved).alpha - base.alpha).abs() < 1e-9
    assert clear.float().mean() > 0.9, "the scene has too many pixels at its cut-offs to be a test"
    return clear


def assert_same_picture(actual: RenderOutput, wanted: RenderOutput, where: Tensor) -> None:
    """Every image within 1e-5 (depth: of its scale) at the pixels `where`."""
    for name, image in images(wanted).items():
        got = images(actual)[name].double().cpu()
        scale = max(1.0, float(image.abs().max())) if name == "depth" else 1.0
        error = (got - image)[where].abs().max() / scale
        assert error <= 1e-5, f"{name} is off by {error:.2e}"


def assert_close_gradient(name: str, actual: Tensor | None, wanted: Tensor) -> None:
    """Relative L2 error within 1e-4, hence the cosine within 1e-8 of 1."""
    assert actual is not None, f"no gradient reached {name}"
    assert torch.isfinite(actual).all(), f"gradient of {name} is not finite"
    a, b = actual.double().cpu().flatten(), wanted.double().flatten()
    error = (a - b).norm() / b.norm()
    cosine = a @ b / (a.norm() * b.norm())
    assert error <= 1e-4, f"gradient of {name}: relative L2 error {error:.2e}"
    assert cosine >= 1 - 1e-7, f"gradient of {name}: cosine {cosine}"
