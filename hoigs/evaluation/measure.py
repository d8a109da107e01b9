"""Size and render time of a model."""

from __future__ import annotations

import math
import statistics
import time
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.model.scene import SceneModel
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip
from hoigs.core.values.moment import Moment
from hoigs.evaluation.scores import PartSize, Timing


def model_size(model: SceneModel) -> list[PartSize]:
    """The size of each entity, and of the interaction module and the decoder if there are any."""
    parts = []
    for name in model.entities:
        entity = model.entity(name)
        parts.append(PartSize(name, entity.kind, len(entity), *_stored(entity)))
    for kind, module in (("interaction", model.interaction), ("decoder", model.decoder)):
        if module is not None:
            parts.append(PartSize(type(module).__name__, kind, 0, *_stored(module)))
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
        output = model.draw(gaussians, camera, RenderRequest(), moment)
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


# Orbits: camera paths around a scene that stay near the views of the video.


def orbit_cameras(
    clip: Clip,
    model: SceneModel,
    count: int,
    *,
    amplitude: float = 20.0,
    position: int | None = None,
) -> list[Camera]:
    """A closed path of `count` cameras about the human's pelvis.

    The camera of a frame is rotated rigidly about the pivot along a horizontal figure of eight:
    `amplitude` degrees to each side and a quarter of that up and down, so that the view stays near
    those of the video. The pivot keeps its pixel.

    Args:
        model: gives the pivot. amplitude: degrees.
        position: of the frame in the clip; by default the middle one.
    """
    position = len(clip) // 2 if position is None else position
    camera = clip.cameras[position]
    center = pivot(model, clip, clip.moments[position], camera)
    up = clip.up()
    right = torch.nn.functional.normalize(camera.world_to_camera[0, :3], dim=0)
    path = []
    for i in range(count):
        phase = 2 * math.pi * i / max(1, count)
        yaw = math.radians(amplitude) * math.sin(phase)
        pitch = math.radians(amplitude) / 4 * math.sin(2 * phase)
        turn = axis_angle_to_matrices(up * yaw) @ axis_angle_to_matrices(right * pitch)
        path.append(turned(camera, center, turn))
    return path


def turned(camera: Camera, center: Float[Tensor, " 3"], turn: Float[Tensor, "3 3"]) -> Camera:
    """The camera rotated about `center`, metres, by the rotation `turn` of the world."""
    # a rotated camera sees what the old one sees of the world rotated back
    back = torch.eye(4).to(camera.world_to_camera)
    back[:3, :3] = turn.mT
    back[:3, 3] = center - turn.mT @ center
    return replace(camera, world_to_camera=camera.world_to_camera @ back)


@torch.no_grad()
def pivot(model: SceneModel, clip: Clip, moment: Moment, camera: Camera) -> Float[Tensor, " 3"]:
    """World position of a pelvis, else the mean of the objects, else a point of the scene."""
    moment = moment.to(model.device)
    for name in model.names("human"):
        anchors = model.entity(name).role(moment).anchors
        if anchors is not None:
            return anchors[0].to(camera.world_to_camera)
    moving = model.names("human") + model.names("object")
    if moving:
        means = model(moment, moving).joined().means
        return means.mean(0).to(camera.world_to_camera)
    depth = camera.to_camera(clip.points.to(camera.world_to_camera))[:, 2]
    ahead = depth[depth > 0]
    distance = ahead.median() if len(ahead) else torch.tensor(2.0)
    middle = torch.tensor([camera.width / 2, camera.height / 2]).to(camera.world_to_camera)
    return camera.unproject(middle, distance)
