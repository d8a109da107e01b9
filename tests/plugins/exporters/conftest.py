"""The tiny run, opened, and a request to export it."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from exported_run import tiny_run

from hoigs.core.model.compose import compose_bodies
from hoigs.core.model.exporter import ExportRequest
from hoigs.runs.loaded_run import LoadedRun
from hoigs.workflows.export import export_moments


@pytest.fixture(scope="session")
def loaded() -> LoadedRun:
    return LoadedRun.open(tiny_run())


@pytest.fixture(scope="session")
def request_of(loaded) -> Callable[..., ExportRequest]:
    """A request for some entities from one frame to another."""
    bodies = compose_bodies(loaded.spec, loaded.clip)

    def make(*entities: str, start=0.0, end=3.0, slow=1.0) -> ExportRequest:
        moments, fps = export_moments(loaded.clip, start, end, None, slow)
        return ExportRequest(loaded.model, loaded.clip, tuple(moments), entities, bodies, fps)

    return make


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
