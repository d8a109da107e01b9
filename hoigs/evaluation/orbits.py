"""Orbits: camera paths around a scene that stay near the views of the video."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.model.scene import SceneModel
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip
from hoigs.core.values.moment import Moment


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
