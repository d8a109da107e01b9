"""Small parts of the whole hoigs spec, for tests of what plays or records all of it at once."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from hoigs.core.model.scene import SceneModel
from hoigs.core.values.clip import ObjectTrack
from hoigs.core.values.gaussians import Gaussians
from hoigs.plugins.deformation.hexplane_skinning import HexPlaneSkinning
from hoigs.testing.material import TinyBody


def things(frames: int) -> tuple[TinyBody, Gaussians, Gaussians, ObjectTrack]:
    """A body, a wall behind it, a box beside it, and the box's way; seeds torch's dice first."""
    torch.manual_seed(0)
    wall = Gaussians.from_points(torch.rand(40, 3) + torch.tensor((-0.5, -0.5, 1.5)), sh_degree=1)
    box = Gaussians.from_points(0.2 * torch.rand(20, 3) + torch.tensor((0.6, 0.3, 0.0)))
    turns = torch.linspace(0, 1, frames)
    track = ObjectTrack(
        points=box.means,
        colors=torch.rand(20, 3),
        rotations=torch.stack([about_y(float(t)) for t in turns]),
        translations=torch.stack((turns, turns.square(), 0 * turns), 1),
        observed=torch.ones(frames, dtype=torch.bool),
    )
    return TinyBody(), wall, box, track


def person_of(
    body: TinyBody, frames: int, trained: tuple[int, ...], **settings: Any
) -> HexPlaneSkinning:
    """HOIGS's human with few cells; its poses are refined at the trained frames."""
    sizes = {"resolution": 8, "channels": 4, "time_resolution": 4, "field_points": 64, "width": 16}
    fields = HexPlaneSkinning.Config.model_fields
    sizes |= {name: settings.pop(name) for name in [*settings] if name in fields}
    given = {"num_frames": frames, "trained_frames": trained} | settings
    return HexPlaneSkinning(HexPlaneSkinning.Config(**sizes), body=body, **given)


def away_from_start(model: SceneModel) -> SceneModel:
    """The same model with every head and correction moved off its zero."""
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if "planes" not in name and name.rpartition(".")[2] not in ("means", "log_scales"):
                parameter += 0.03 * torch.randn_like(parameter)
    return model


def about_y(angle: float) -> Tensor:
    """A rotation, [3, 3]."""
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor(((c, 0.0, s), (0.0, 1.0, 0.0), (-s, 0.0, c)))
