"""Size and render time of a model."""

from __future__ import annotations

import statistics
import time

import torch
from torch import nn

from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.core.model.scene import SceneModel
from hoigs.core.values.clip import Clip
from hoigs.evaluation.scores import PartSize, Timing


def model_size(model: SceneModel) -> list[PartSize]:
    """The size of each entity, and of the interaction module if there is one."""
    parts = []
    for name in model.entities:
        entity = model.entity(name)
        parts.append(PartSize(name, entity.kind, len(entity), *_stored(entity)))
    if model.interaction is not None:
        kind = type(model.interaction).__name__
        parts.append(PartSize(kind, "interaction", 0, *_stored(model.interaction)))
    return parts


def _stored(module: nn.Module) -> tuple[int, float]:
    """The number of trained scalars, and megabytes of all tensors of a checkpoint."""
    trained = sum(p.numel() for p in module.parameters() if p.requires_grad)
    size = sum(t.numel() * t.element_size() for t in module.state_dict().values())
    return trained, size / 1e6


@torch.no_grad()
def render_time(
    model: SceneModel,
    clip: Clip,
    positions: list[int],
    *,
    frames: int = 100,
    warmup: int = 10,
    budget_s: float = 60.0,
) -> Timing:
    """Render `positions` in turn, and time deformation and rasterization separately.

    Stops after `budget_s` seconds, but not before 3 frames; `Timing.note` then mentions it.
    """
    device = model.device
    views = [(clip.moments[p].to(device), clip.cameras[p].to(device)) for p in positions]
    deform: list[float] = []
    raster: list[float] = []
    total: list[float] = []
    drawn: list[int] = []
    started = time.perf_counter()
    warmed = 0
    note = "what does not depend on time may be cached"
    for step in range(frames + warmup):
        late = time.perf_counter() - started > budget_s
        if late and len(total) >= 3:
            note += f"; stopped after {budget_s:g} s, short of {frames} frames"
            break
        moment, camera = views[step % len(views)]
        start = _now(device)
        gaussians = model(moment).joined()
        middle = _now(device)
        output = model.draw(gaussians, camera, RenderRequest())
        end = _now(device)
        if step < warmup and not late:
            warmed += 1
            continue
        deform.append(middle - start)
        raster.append(end - middle)
        total.append(end - start)
        drawn.append(int((output.info["radii"] > 0).sum()))
    width, height = views[0][1].width, views[0][1].height
    return Timing(
        frames=len(total),
        warmup=warmed,
        deform_ms=1000 * statistics.median(deform),
        raster_ms=1000 * statistics.median(raster),
        total_ms=1000 * statistics.median(total),
        drawn=int(statistics.median(drawn)),
        width=width,
        height=height,
        device=device_name(device),
        rasterizer=type(model.rasterizer).__name__,
        note=note,
    )


def _now(device: torch.device) -> float:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def device_name(device: torch.device) -> str:
    """The name of the GPU, or the number of CPU threads."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    threads = torch.get_num_threads()
    return f"{device.type}, {threads} thread{'s' if threads > 1 else ''}"
