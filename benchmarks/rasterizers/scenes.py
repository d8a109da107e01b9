"""The scenes: gsplat's garden, or a ball of random splats where that file is absent."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians

SHARED = Path(os.environ.get("HOIGS_SHARED", Path(__file__).parents[3] / "shared"))
GARDEN = SHARED / "data" / "garden.npz"


@dataclass(frozen=True)
class Case:
    """An image size and a number of Gaussians, written 1280x720/100000."""

    width: int
    height: int
    count: int

    @staticmethod
    def parse(text: str) -> Case:
        size, count = text.split("/")
        width, height = size.split("x")
        return Case(int(width), int(height), int(count))

    @property
    def size(self) -> str:
        return f"{self.width}x{self.height}"

    def __str__(self) -> str:
        return f"{self.size}/{self.count}"


def synthetic(count: int, sh_degree: int, seed: int = 0) -> tuple[Gaussians, Camera]:
    """A ball of splats, some pixels each."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    gaussians = Gaussians(
        means=normal(count, 3) * 0.6,
        quats=normal(count, 4),
        log_scales=normal(count, 3) * 0.5 - 2.2 - math.log(count / 1000) / 3,
        opacity_logits=normal(count),
        sh=normal(count, (sh_degree + 1) ** 2, 3) * 0.2,
    )
    eye, target = torch.tensor([0.5, -0.6, -3.0]), torch.zeros(3)
    return gaussians, Camera.look_at(eye, target, width=512, height=512, fov_y=0.8)


def garden(
    count: int, sh_degree: int, path: Path = GARDEN, seed: int = 0
) -> tuple[Gaussians, Camera]:
    """gsplat's test asset cropped to 2 m: scales from neighbours, times lognormal(0.5).

    Bands above the first, opacities and rotations are random.
    """
    data = np.load(path)
    points = torch.from_numpy(data["means3d"])
    colors = torch.from_numpy(data["colors"]).float() / 255
    inside = (points.abs() < 2).all(1).nonzero().squeeze(1)
    generator = torch.Generator().manual_seed(seed)
    chosen = inside[torch.randperm(len(inside), generator=generator)[:count]]
    gaussians = Gaussians.from_points(points[chosen], colors[chosen], sh_degree=sh_degree)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    gaussians = gaussians.replace(
        log_scales=gaussians.log_scales + 0.5 * normal(len(chosen), 3),
        quats=normal(len(chosen), 4),
        opacity_logits=normal(len(chosen)),
    )
    gaussians.sh[:, 1:] = 0.05 * normal(len(chosen), (sh_degree + 1) ** 2 - 1, 3)
    K, view = (torch.from_numpy(data[name][0]).float() for name in ("Ks", "viewmats"))
    return gaussians, Camera(K, view, int(data["width"]), int(data["height"]))


def build(
    scene: str, case: Case, sh_degree: int, path: Path, device: torch.device
) -> tuple[Gaussians, Camera]:
    """The Gaussians of a case and its camera, on a device."""
    if scene == "garden":
        gaussians, camera = garden(case.count, sh_degree, path)
    else:
        gaussians, camera = synthetic(case.count, sh_degree)
    return gaussians.to(device), camera.resized(case.width, case.height).to(device)
