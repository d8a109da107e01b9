"""Clips of things that move as told, drawn from known Gaussians: cheap truth for motion models."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from recorded import Recorded
from torch import Tensor

from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import BodyTrack, Clip, ObjectTrack
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.rasterizers.torch_tiles import TorchRasterizer
from hoigs.synthesis import SceneConfig
from hoigs.synthesis.object_motions import MOTIONS


@dataclass(frozen=True)
class Thing:
    """A speckled box (or any cloud) and its rigid motion."""

    shape: Gaussians
    rotations: Tensor
    translations: Tensor

    def at(self, frame: int) -> Gaussians:
        turn = self.rotations[frame]
        return self.shape.replace(means=self.shape.means @ turn.mT + self.translations[frame])

    def track(self) -> ObjectTrack:
        return ObjectTrack(
            self.shape.means,
            self.shape.colors,
            self.rotations,
            self.translations,
            torch.ones(len(self.rotations), dtype=torch.bool),
        )


def speckled_box(count: int = 80, size: float = 0.5, seed: int = 0) -> Gaussians:
    """Opaque spots in a cube, coloured smoothly, so that poses have a wide basin."""
    generator = torch.Generator().manual_seed(seed)
    points = size * (torch.rand(count, 3, generator=generator) - 0.5)
    waves = 9 * torch.randn(3, 3, generator=generator) / 3**0.5
    colors = 0.5 + 0.45 * torch.sin(points @ waves + 1.0)
    return Gaussians.from_points(points, colors, scales=0.06, opacity=0.9)


def scripted(motion: str, frames: int, shape: Gaussians | None = None) -> Thing:
    """A thing that moves as the built-in clips' object does: its exact poses."""
    config = SceneConfig.model_validate({"frames": frames, "object": {"motion": motion}})
    track = MOTIONS[motion](config).script().track
    return Thing(
        speckled_box() if shape is None else shape,
        torch.from_numpy(np.ascontiguousarray(track.rotations)).float(),
        torch.from_numpy(np.ascontiguousarray(track.translations)).float(),
    )


def backdrop(count: int = 300, seed: int = 3) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)
    spread = torch.tensor([3.0, 3.0, 0.1])
    points = (torch.rand(count, 3, generator=generator) - 0.5) * spread
    points = points + torch.tensor([0.0, 1.0, -1.2])
    colors = torch.rand(count, 3, generator=generator) * 0.5
    return Gaussians.from_points(points, colors, scales=0.15, opacity=0.9)


def clip_of(
    things: Mapping[str, Thing],
    *,
    size: int = 64,
    frames: int,
    tracks: Mapping[str, ObjectTrack] | None = None,
    bodies: Mapping[str, BodyTrack] | None = None,
    drawn_bodies: Mapping[str, list[Gaussians]] | None = None,
    distance: float = 2.6,
) -> Clip:
    """Every thing before a backdrop, seen by one camera that stands still.

    Args:
        tracks: what the clip says of the things' motion, where that is not the truth.
    """
    eye, target = torch.tensor([0.3, 1.2, distance]), torch.tensor([0.0, 1.0, 0.0])
    camera = Camera.look_at(eye, target, width=size, height=size, fov_y=0.7)
    scene, draw = backdrop(), TorchRasterizer()
    names = [*things, *(bodies or {})]
    images: list[Tensor] = []
    masks: dict[str, list[Tensor]] = {name: [] for name in names}
    moments = []
    for f in range(frames):
        parts = {name: thing.at(f) for name, thing in things.items()}
        for name, drawn in (drawn_bodies or {}).items():
            parts[name] = drawn[f]
        with torch.no_grad():
            color = draw.render(Gaussians.cat([scene, *parts.values()]), camera).color
            for name, part in parts.items():
                masks[name].append(draw.render(part, camera).alpha > 0.5)
        images.append((255 * color.clamp(0, 1)).round().to(torch.uint8))
        poses = {n: b.poses.frame(f) for n, b in (bodies or {}).items()}
        moments.append(Moment(f / (frames - 1), f, poses))
    kinds = {**dict.fromkeys(things, "object"), **dict.fromkeys(bodies or {}, "human")}
    return Clip(
        name="moving",
        store=Recorded(images, masks),
        cameras=[camera] * frames,
        moments=moments,
        kinds=kinds,  # type: ignore[arg-type]
        bodies=dict(bodies or {}),
        objects={n: (tracks or {}).get(n, t.track()) for n, t in things.items()},
        points=scene.means,
        point_colors=scene.colors,
        split={"train": list(range(frames)), "test": []},
    )
