"""The tiny run, opened, and a request to export it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from exported_run import tiny_run
from scipy.spatial.transform import Rotation

from hoigs.core.model.compose import compose_bodies
from hoigs.core.model.exporter import ExportRequest
from hoigs.core.values.world import World
from hoigs.runs.loaded_run import LoadedRun
from hoigs.viewing.export import export_moments


@pytest.fixture(scope="session")
def loaded() -> LoadedRun:
    return LoadedRun.open(tiny_run())


@pytest.fixture(scope="session")
def request_of(loaded) -> Callable[..., ExportRequest]:
    """A request for some entities from one frame to another, in a tilted world whose floor is
    not at its origin."""
    bodies = compose_bodies(loaded.spec, loaded.clip)
    clip = replace(loaded.clip, world=World(up=(0.3, 0.9, -0.3), floor=0.4))

    def make(*entities: str, start=0.0, end=3.0, slow=1.0) -> ExportRequest:
        moments, fps = export_moments(loaded.clip, start, end, None, slow)
        return ExportRequest(loaded.model, clip, tuple(moments), entities, bodies, fps)

    return make


@pytest.fixture(scope="session")
def upright() -> Callable[..., np.ndarray]:
    """The rigid motion [4, 4] that turns a world by the smallest angle so that an axis is up, and
    lifts its floor to 0; written anew here."""

    def matrix(request: ExportRequest, axis: str) -> np.ndarray:
        moved = np.eye(4)
        if axis == "clip":
            return moved
        up, goal = np.array(request.clip.world.up), np.eye(3)["xyz".index(axis)]
        across = np.cross(up, goal)
        angle = np.arccos(up @ goal)
        moved[:3, :3] = Rotation.from_rotvec(angle * across / np.linalg.norm(across)).as_matrix()
        moved[:3, 3] = -request.clip.world.floor * goal
        return moved

    return matrix


@pytest.fixture(scope="session")
def psnr_to_ours(loaded) -> Callable[..., float]:
    """PSNR in dB between the run and Gaussians, both drawn from the camera of a frame."""
    import torch

    @torch.no_grad()
    def score(gaussians, frame: int, entities=(), camera=None) -> float:
        camera = camera or loaded.clip.cameras[frame]
        ours = loaded.model.render(
            loaded.clip.moments[frame], loaded.clip.cameras[frame], only=entities or None
        ).color
        theirs = loaded.model.draw(gaussians, camera).color
        error = (ours - theirs).square().mean()
        return float(-10 * torch.log10(error.clamp_min(1e-12)))

    return score
