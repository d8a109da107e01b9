"""A small scene with all parts of the hoigs spec, and graphed steps of it beside eager ones."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor
from whole_scene import away_from_start, person_of, things

from hoigs.core.interfaces.body import BodyModel
from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.interfaces.features import FeatureExtractor
from hoigs.core.model.entity import Entity
from hoigs.core.model.scene import SceneModel
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip, FrameStore, ObjectTrack
from hoigs.core.values.moment import BodyPose, Moment
from hoigs.plugins.deformation.articulated import Articulated
from hoigs.plugins.deformation.chs import CubicHermite
from hoigs.plugins.deformation.keyframes import Keyframed
from hoigs.plugins.deformation.lbs import Lbs
from hoigs.plugins.deformation.rigid_residual import RigidResidual
from hoigs.plugins.deformation.rigid_spline import RigidSpline
from hoigs.plugins.deformation.static import Static
from hoigs.plugins.deformation.tracked_chs import TrackedHermite
from hoigs.plugins.features.body_parts import BodyPartFeatures
from hoigs.plugins.features.embedding import EmbeddingFeatures
from hoigs.plugins.features.spline_motion import SplineMotionFeatures
from hoigs.plugins.interaction.cross_attention import CrossAttention
from hoigs.plugins.interaction.none import NoInteraction
from hoigs.rasterizers.torch_tiles import TorchRasterizer
from hoigs.training.graphs import GraphedScene

FRAMES = 6


def scene(
    human: dict[str, Any] | None = None,
    thing: dict[str, Any] | None = None,
    attention: dict[str, Any] | None = None,
    *,
    plain_tokens: bool = False,
    unattended: bool = False,
    person: Callable[..., DeformationModel] = person_of,
    motion: Callable[..., DeformationModel] | None = None,
) -> SceneModel:
    """All parts of the hoigs spec, small, every head and correction away from its start.

    Args:
        unattended: without features and interaction. person, motion: made with its settings.
    """
    body, wall, box, track = things(FRAMES)
    walker = person(body, FRAMES, (0, 1, 3, 4), **(human or {}))
    curve = (motion or keyframed(TrackedHermite))(track, **(thing or {}))
    features: list[FeatureExtractor | None] = [
        BodyPartFeatures(),
        SplineMotionFeatures(SplineMotionFeatures.Config(hidden=8)),
    ]
    if plain_tokens:
        features = [EmbeddingFeatures(), EmbeddingFeatures(EmbeddingFeatures.Config(keyframes=3))]
    if unattended:
        features = [None, None]
    attends = CrossAttention(CrossAttention.Config(hidden=16, reach=3.0, **(attention or {})))
    model = SceneModel(
        {
            "scene": Entity(wall, Static(), kind="scene"),
            "human": Entity(body.canonical(80), walker, features[0]),
            "object": Entity(box, curve, features[1], kind="object"),
        },
        interaction=NoInteraction() if unattended else attends,
        rasterizer=TorchRasterizer(),
    )
    return away_from_start(model).train()


def skinned(body: BodyModel, frames: int, trained: tuple[int, ...], refine_poses: bool) -> Lbs:
    config = Lbs.Config(refine_poses=refine_poses)
    return Lbs(config, body=body, num_frames=frames, trained_frames=trained)


def keyframed(motion: type[Keyframed], **settings: Any) -> Callable[..., Keyframed]:
    """Makes a motion along a track, over four knots."""

    def make(track: ObjectTrack, **others: Any) -> Keyframed:
        config = motion.Config(**{"keyframes": 4, **settings, **others})
        return motion(config, track=track, cameras=cameras())

    return make


def adaptive(motion: type[Keyframed], **settings: Any) -> Callable[..., Keyframed]:
    """Makes a motion whose knots stand where a schedule may put them, here a little off uniform."""

    def make(track: ObjectTrack, **others: Any) -> Keyframed:
        made = keyframed(motion, keyframes="adaptive", **settings)(track, **others)
        made.knots.place([0.0, 0.3, 0.8, 1.0])
        return made

    return make


def cameras() -> list[Camera]:
    intrinsics = torch.tensor([[60.0, 0.0, 32.0], [0.0, 60.0, 32.0], [0.0, 0.0, 1.0]])
    return [Camera(intrinsics, torch.eye(4), 64, 64)] * FRAMES


class Noise(FrameStore):
    """Square pictures of coloured noise."""

    def __init__(self, side: int) -> None:
        generator = torch.Generator().manual_seed(3)
        self.images = torch.randint(0, 256, (FRAMES, side, side, 3), generator=generator)

    def image(self, position: int) -> Tensor:
        return self.images[position].to(torch.uint8)

    def depth(self, position: int) -> Tensor | None:
        return None


def filmed(pictures: Noise, **settings: Any) -> Clip:
    """A clip by a camera that moves past."""
    side = pictures.images.shape[1]
    views = [
        Camera.look_at(
            torch.tensor((0.2 * i - 0.5, 0.2, -2.5)), torch.tensor((0.0, 0.0, 0.5)),
            width=side, height=side, fov_y=0.9, up=(0.0, -1.0, 0.0),
        )
        for i in range(FRAMES)
    ]  # fmt: skip
    return Clip(
        "noise",
        pictures,
        views,
        [at(f) for f in range(FRAMES)],
        kinds={"human": "human", "object": "object"},
        points=torch.rand(9, 3),
        point_colors=torch.rand(9, 3),
        split={"train": [0, 1, 3, 4], "test": [2, 5]},
        **settings,
    )


def at(frame: float) -> Moment:
    time = frame / (FRAMES - 1)
    generator = torch.Generator().manual_seed(round(1000 * time))
    pose = BodyPose.zeros(betas=2).replace(
        body=0.3 * torch.randn(21, 3, generator=generator),
        transl=torch.tensor((0.2 * time, 0.0, 0.0)),
        betas=torch.tensor((0.5, -0.3 + 0.1 * time)),  # clips may have another one a frame
    )
    return Moment(time, round(frame), {"human": pose})


def weight_of(model: SceneModel) -> Any:
    return lambda name, key: model.entity(name).deformation.regularizer_weights.get(key, 0.0)


def loss(graphed: GraphedScene, model: SceneModel, moment: Moment) -> Tensor:
    """One that every Gaussian's every number is part of, alone and joined, and all penalties."""
    deformed = graphed(moment)
    total = torch.zeros((), device=model.device)
    for part in (deformed.state.joined(), deformed.state.gaussians["human"]):
        for value in part.tensors().values():
            ramp = torch.linspace(-1, 2, value.numel(), device=value.device).view(value.shape)
            total = total + (ramp * value.sin()).sum()
    for name in model.entities:
        known = deformed.penalties and deformed.penalties[name]
        for key, value in (known or model.entity(name).regularizers()).items():
            total = total + weight_of(model)(name, key) * value
    return total


def gradients(model: SceneModel) -> dict[str, Tensor | None]:
    return {n: None if p.grad is None else p.grad.clone() for n, p in model.named_parameters()}


def apart(ours: Tensor, theirs: Tensor) -> float:
    return float((ours - theirs).norm() / theirs.norm().clamp_min(1e-12))


def same_gradients(
    mine: dict[str, Tensor | None], wanted: dict[str, Tensor | None], allowed: float, floor: float
) -> int:
    """Norms of differences: `allowed` of each gradient's own, and `floor` of the largest; how many
    there were."""
    compared = 0
    largest = max(float(g.norm()) for g in wanted.values() if g is not None)
    for name, gradient in wanted.items():
        other = mine[name]
        assert (other is None) == (gradient is None), name
        if gradient is not None and other is not None:
            difference = float((other - gradient).norm())
            assert difference < allowed * float(gradient.norm()) + floor * largest, name
            compared += 1
    return compared


def compared(model: SceneModel, graphed: GraphedScene, moments: list[Moment]) -> None:
    """Check values and gradients of a graphed model at moments against eager execution."""
    plain = GraphedScene(model, "off", weight_of(model))
    for moment in moments:
        found = []
        for way in (graphed, plain):
            model.zero_grad(set_to_none=True)
            value = loss(way, model, moment)
            value.backward()
            found.append((value.detach(), gradients(model)))
        (ours, mine), (theirs, wanted) = found
        assert apart(ours, theirs) < 1e-6
        same_gradients(mine, wanted, 2e-6, 1e-8)


def uncaptured(model: SceneModel) -> GraphedScene:
    made = GraphedScene(model, "auto", weight_of(model), kernel_by_kernel=True)
    assert made.mode == "cached", made.reason
    return made


VARIANTS: dict[str, dict[str, Any]] = {
    "hoigs": {},
    "product planes": {"human": {"fusion": "product"}},
    "canonical field, exavatar head": {"human": {"field_at": "canonical", "head": "exavatar"}},
    "mesh laplacian": {"human": {"laplacian": "mesh", "residual_rule": "compose"}},
    "finite differences": {"thing": {"tangents": "finite-difference", "opacity": "constant"}},
    "chs": {"motion": keyframed(CubicHermite)},
    "heads": {"attention": {"pose_head": "per-part", "object_residual": "both", "gate": "hard"}},
    "plain tokens": {"plain_tokens": True},
    "given poses": {"human": {"refine_poses": False}},
    "clothes": {"human": {"nonrigid": True}},
    "shading": {"human": {"nonrigid": "shading", "free_attributes": "all"}},
    "light": {"human": {"light": True}, "thing": {"light": True, "opacity": "constant"}},
    "skinned": {"person": partial(skinned, refine_poses=False), "unattended": True},
    "skinned, refined": {"person": partial(skinned, refine_poses=True), "unattended": True},
    "rigid": {"motion": keyframed(RigidSpline)},
    "rigid, adaptive": {"motion": adaptive(RigidSpline)},
    "rigid, slerp": {"motion": keyframed(RigidSpline, rotation="slerp")},
    "rigid, differences": {"motion": keyframed(RigidSpline, tangents="finite-difference")},
    "rigid, residual": {"motion": adaptive(RigidResidual, residual_step=2)},
    "articulated": {"motion": adaptive(Articulated)},
}
