"""A clip of a head that looks about, drawn from a model that is known."""

from __future__ import annotations

import functools

import torch
from recorded import Recorded

from hoigs.core.model.entity import Entity
from hoigs.core.model.scene import SceneModel
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import BodyTrack, Clip
from hoigs.core.values.gaussians import SH_C0, Gaussians
from hoigs.core.values.moment import BodyPose, Moment
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.plugins.deformation.hexplane_skinning import HexPlaneSkinning
from hoigs.plugins.deformation.static import Static
from hoigs.rasterizers.torch_tiles import TorchRasterizer

SIZE, FRAMES, POINTS = 48, 5, 3500


def painted() -> SceneModel:
    """A person with a smoothly coloured head before a wall, the truth of the clip."""
    torch.manual_seed(0)
    body = AnnyBody()
    config = HexPlaneSkinning.Config(
        resolution=8, channels=4, time_resolution=4, width=16, field_points=160
    )
    model = HexPlaneSkinning(config, body=body, num_frames=FRAMES)
    person = Entity(body.canonical(POINTS), model)
    with torch.no_grad():
        waves = torch.sin(45 * person.means + torch.tensor([0.0, 1.0, 2.0]))
        person.sh[:, 0] = 0.4 * waves / SH_C0
        person.log_scales.fill_(-5.0)
    wall = torch.rand(500, 3) * torch.tensor([1.0, 1.0, 0.1]) + torch.tensor([-0.5, 0.3, -1.0])
    scene = Entity(Gaussians.from_points(wall, torch.rand(500, 3), opacity=0.9), Static())
    return SceneModel({"scene": scene, "human": person}, rasterizer=TorchRasterizer())


def poses(betas: int) -> BodyPose:
    pose = BodyPose.zeros(FRAMES, betas=betas)
    turn = torch.linspace(-0.3, 0.3, FRAMES)
    body = pose.body.clone()
    body[:, 14, 1] = turn  # the head looks about
    return pose.replace(body=body)


@functools.cache
def portrait() -> tuple[SceneModel, Clip]:
    """Five frames of the head, from the front, and the model that they were drawn from."""
    model = painted()
    track = poses(model.entity("human").deformation.body.num_betas)
    moments = [Moment(i / (FRAMES - 1), i, {"human": track.frame(i)}) for i in range(FRAMES)]
    cameras, images, masks = [], [], []
    for i, moment in enumerate(moments):
        eye = torch.tensor([0.05 * i - 0.1, 0.75, 1.2])
        target = torch.tensor([0.0, 0.73, 0.0])
        camera = Camera.look_at(eye, target, width=SIZE, height=SIZE, fov_y=0.35)
        with torch.no_grad():
            color = model.render(moment, camera).color
            alpha = model.render(moment, camera, only=["human"]).alpha
        cameras.append(camera)
        images.append((255 * color.clamp(0, 1)).round().to(torch.uint8))
        masks.append(alpha > 0.5)
    clip = Clip(
        "portrait", Recorded(images, {"human": masks}), cameras, moments,
        kinds={"human": "human"}, bodies={"human": BodyTrack("body:anny", track)}, objects={},
        points=torch.zeros(0, 3), point_colors=torch.zeros(0, 3),
        split={"train": list(range(FRAMES)), "test": []},
    )  # fmt: skip
    return model, clip
