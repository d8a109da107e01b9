"""A small world made of Gaussians: a back wall, a "human" blob that sways, a ball it meets."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.model.entity import Entity
from hoigs.core.model.scene import SceneModel
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip, FrameStore
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import EntityKind, Residual
from hoigs.rasterizers.torch_tiles import TorchRasterizer

FRAMES, WIDTH, HEIGHT = 8, 48, 32
KINDS: dict[str, EntityKind] = {"man": "human", "ball": "object"}


class Swing(DeformationModel):
    """Slides along x: amplitude * cos(pi t), metres."""

    def __init__(self, amplitude: float) -> None:
        super().__init__()
        self.amplitude = torch.nn.Parameter(torch.tensor(amplitude))

    def forward(
        self, canonical: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        del residual
        shift = self.amplitude * math.cos(math.pi * moment.time)
        return replace(
            canonical, means=canonical.means + torch.stack((shift, shift * 0, shift * 0))
        )


class MemoryStore(FrameStore):
    def __init__(
        self, images: list[Tensor], masks: dict[str, list[Tensor]], depths: list[Tensor] | None
    ) -> None:
        self.images, self.masks, self.depths = images, masks, depths

    def image(self, position: int) -> Tensor:
        return self.images[position]

    def mask(self, entity: str, position: int) -> Tensor:
        return self.masks[entity][position]

    def depth(self, position: int) -> Tensor | None:
        return None if self.depths is None else self.depths[position]


def cloud(count: int, center: tuple[float, float, float], spread: tuple[float, float, float],
          color: tuple[float, float, float], seed: int, size: float) -> Gaussians:  # fmt: skip
    generator = torch.Generator().manual_seed(seed)
    offsets = 2 * torch.rand(count, 3, generator=generator) - 1
    points = torch.tensor(center) + offsets * torch.tensor(spread)
    colors = torch.tensor(color) + 0.4 * (torch.rand(count, 3, generator=generator) - 0.5)
    return Gaussians.from_points(points, colors.clamp(0, 1), scales=size, opacity=0.95)


def build_model() -> SceneModel:
    wall = cloud(150, (0, 0, 4), (2.6, 2.0, 0.02), (0.5, 0.55, 0.6), 0, 0.28)
    man = cloud(60, (-0.25, 0, 2.5), (0.16, 0.5, 0.08), (0.8, 0.4, 0.3), 1, 0.07)
    ball = cloud(30, (0.3, 0.1, 2.4), (0.12, 0.12, 0.12), (0.2, 0.6, 0.6), 2, 0.05)
    return SceneModel(
        {
            "wall": Entity(wall, Swing(0.0), kind="scene"),
            "man": Entity(man, Swing(-0.1), kind="human"),
            "ball": Entity(ball, Swing(0.25), kind="object"),
        },
        rasterizer=TorchRasterizer(),
    )


def build_camera(x: float) -> Camera:
    eye, target = torch.tensor([x, 0.0, 0.0]), torch.tensor([0.0, 0.0, 2.5])
    return Camera.look_at(
        eye, target, width=WIDTH, height=HEIGHT, fov_y=math.radians(45), up=(0.0, -1.0, 0.0)
    )


@torch.no_grad()
def film(model: SceneModel, cameras: list[Camera], moments: list[Moment]) -> MemoryStore:
    images, depths = [], []
    masks: dict[str, list[Tensor]] = {name: [] for name in KINDS}
    for camera, moment in zip(cameras, moments, strict=True):
        output = model.render(moment, camera)
        images.append((output.color.clamp(0, 1) * 255).round().to(torch.uint8))
        depths.append(torch.where(output.alpha > 0.5, output.expected_depth, torch.zeros(())))
        for name in KINDS:
            masks[name].append(model.render(moment, camera, only=[name]).alpha > 0.5)
    return MemoryStore(images, masks, depths)


@pytest.fixture(scope="session")
def _clip() -> Clip:
    truth = build_model()
    cameras = [build_camera(0.3 * (i / (FRAMES - 1) - 0.5)) for i in range(FRAMES)]
    moments = [Moment(i / (FRAMES - 1), i) for i in range(FRAMES)]
    seen = [moments[2], moments[4]]
    aside = [build_camera(-0.5), build_camera(0.5)]
    shared = {
        "kinds": KINDS, "bodies": {}, "objects": {}, "depth_kind": "metric", "fps": 10.0,
        "points": truth.entity("wall").means.detach(), "point_colors": torch.zeros(150, 3),
    }  # fmt: skip
    held_out = Clip(
        "toy held out", film(truth, aside, seen), aside, seen,
        split={"train": [], "test": [0, 1]}, **shared,
    )  # fmt: skip
    return Clip(
        "toy", film(truth, cameras, moments), cameras, moments,
        split={"train": [0, 1, 3, 4, 6, 7], "test": [2, 5]}, held_out=held_out, **shared,
    )  # fmt: skip


@pytest.fixture
def clip(_clip: Clip) -> Clip:
    return _clip


@pytest.fixture
def model() -> SceneModel:
    """The truth itself; tests spoil it as they need."""
    return build_model()


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> Iterator[None]:
    """Images this small are drawn faster by one thread, far faster on a busy machine."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(autouse=True)
def no_weights(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    """No LPIPS weights but those that a test names."""
    monkeypatch.setenv("HOIGS_LPIPS_WEIGHTS", str(tmp_path / "none.npz"))
