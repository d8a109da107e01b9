"""The conformance kit's scenes and comparisons, under the names that these tests use."""

from __future__ import annotations

from torch import Tensor

from hoigs.core.interfaces.rasterizer import RenderOutput, RenderRequest
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.testing.checks import require_close, require_close_gradient
from hoigs.testing.rasterizer.subject import (
    ORACLE,
    RAW,
    Scene,
    a_camera,
    forged,
    front_camera,
    images,
    one_gaussian,
    reference,
)
from hoigs.testing.rasterizer.subject import RasterizerSubject as Backend
from hoigs.testing.rasterizer.subject import random_gaussians as random_scene

CUT = ORACLE.rasterizer

__all__ = [
    "CUT",
    "RAW",
    "Backend",
    "a_camera",
    "assert_close_gradient",
    "assert_same_picture",
    "clear_of_cutoffs",
    "forged",
    "front_camera",
    "images",
    "one_gaussian",
    "random_scene",
]


def clear_of_cutoffs(gaussians: Gaussians, camera: Camera, request: RenderRequest) -> Tensor:
    """Pixels [H, W] that are not at a cut-off; see `Reference`."""
    return reference(Scene(gaussians, camera, request)).clear


def assert_same_picture(actual: RenderOutput, wanted: RenderOutput, where: Tensor) -> None:
    """Every image within 1e-5 (depth: of its scale) at the pixels `where`."""
    for name, image in images(wanted).items():
        scale = max(1.0, float(image.abs().max())) if name == "depth" else 1.0
        require_close(name, images(actual)[name].cpu()[where], image[where], atol=1e-5 * scale)


def assert_close_gradient(name: str, actual: Tensor | None, wanted: Tensor) -> None:
    """Relative L2 error within 1e-4."""
    require_close_gradient(name, actual, wanted, 1e-4)
