"""A tiny clip with a moving human, object and camera; also written as a folder."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import BodyTrack, Clip, FrameStore, ObjectTrack
from hoigs.core.values.moment import BodyPose, Moment

HUMAN, OBJECT = "human", "object"
FRAMES = 9
WIDTH, HEIGHT = 20, 16
BETAS = (0.4, -0.3)


@cache
def phases() -> dict[str, Tensor]:
    """The phase of each joint's oscillation, radians."""
    generator = torch.Generator().manual_seed(7)
    sizes = {"global_orient": (3,), "body": (21, 3), "left_hand": (15, 3), "right_hand": (15, 3)}
    return {
        name: 2 * math.pi * torch.rand(shape, generator=generator, dtype=torch.float64)
        for name, shape in sizes.items()
    }


def pose_at(time: float, dtype: torch.dtype = torch.float32) -> BodyPose:
    """The human at any time, also beyond the clip: every joint oscillates, the pelvis moves."""
    turns: dict[str, Any] = {
        name: (0.3 * torch.sin(2.5 * time + phase)).to(dtype) for name, phase in phases().items()
    }
    place = torch.tensor((0.3 * time, 0.05 * math.sin(3 * time), 3.0), dtype=dtype)
    return BodyPose(transl=place, betas=torch.tensor(BETAS, dtype=dtype), **turns)


def moment_at(
    time: float, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
) -> Moment:
    """The moment of the tiny clip at `time`, or of its continuation."""
    index = round(min(max(time, 0.0), 1.0) * (FRAMES - 1))
    return Moment(time, index, {HUMAN: pose_at(time, dtype).to(device)})


def camera_at(time: float) -> Camera:
    eye = torch.tensor((0.4 * time - 0.2, -0.3, 0.0))
    return Camera.look_at(
        eye, torch.tensor((0.0, 0.0, 3.0)), width=WIDTH, height=HEIGHT, fov_y=0.9, up=(0, -1, 0)
    )


@cache
def object_track() -> ObjectTrack:
    """64 points, half of them marked as the moving part, that rise and rotate."""
    generator = torch.Generator().manual_seed(3)
    time = torch.linspace(0, 1, FRAMES)
    axis = torch.tensor((0.3, 0.9, 0.2))
    places = torch.stack((0.3 - 0.2 * time, 0.2 * time.square(), 2.8 + 0.1 * time), 1)
    points = (torch.rand(64, 3, generator=generator) - 0.5) * torch.tensor((0.3, 0.2, 0.1))
    return ObjectTrack(
        points=points,
        colors=torch.rand(64, 3, generator=generator),
        rotations=axis_angle_to_matrices(1.2 * time[:, None] * axis),
        translations=places,
        observed=torch.arange(FRAMES) != 4,
        provenance="hoigs.testing",
        moving=points[:, 0] > 0,
    )


@cache
def body_track() -> BodyTrack:
    poses = [pose_at(i / (FRAMES - 1)) for i in range(FRAMES)]
    fields = ("global_orient", "body", "left_hand", "right_hand", "transl")
    stacked: dict[str, Any] = {
        name: torch.stack([getattr(p, name) for p in poses]) for name in fields
    }
    return BodyTrack("body:tiny", BodyPose(betas=torch.tensor(BETAS), **stacked), "hoigs.testing")


class TinyFrames(FrameStore):
    """Pixels computed on access; the pattern shifts from frame to frame."""

    def image(self, position: int) -> UInt8[Tensor, "H W 3"]:
        rows = torch.arange(HEIGHT)[:, None, None] * 9
        columns = torch.arange(WIDTH)[None, :, None] * 5
        return ((rows + columns + torch.tensor((0, 60, 120)) + 20 * position) % 256).to(torch.uint8)

    def mask(self, entity: str, position: int) -> Bool[Tensor, "H W"]:
        mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
        left = 3 + position % 4 if entity == HUMAN else 12
        mask[4:12, left : left + 5] = True
        return mask

    def depth(self, position: int) -> Float[Tensor, "H W"] | None:
        depth = torch.full((HEIGHT, WIDTH), 4.0)
        for entity, metres in ((HUMAN, 3.0), (OBJECT, 2.8)):
            depth[self.mask(entity, position)] = metres
        return depth


@cache
def tiny_clip() -> Clip:
    """Nine frames of 20 x 16 pixels; frames 2 and 6 are for tests."""
    generator = torch.Generator().manual_seed(5)
    times = [i / (FRAMES - 1) for i in range(FRAMES)]
    points = torch.rand(64, 3, generator=generator) * torch.tensor((4.0, 3.0, 2.0))
    test = [2, 6]
    return Clip(
        name="tiny",
        store=TinyFrames(),
        cameras=[camera_at(time) for time in times],
        moments=[moment_at(time) for time in times],
        kinds={HUMAN: "human", OBJECT: "object"},
        bodies={HUMAN: body_track()},
        objects={OBJECT: object_track()},
        points=points + torch.tensor((-2.0, -1.5, 3.0)),
        point_colors=torch.rand(64, 3, generator=generator),
        split={"train": [i for i in range(FRAMES) if i not in test], "test": test},
        depth_kind="metric",
        provenance={"made by": "hoigs.testing"},
    )


def write_tiny_clip(folder: Path) -> Path:
    """The tiny clip as a clip folder of hoigs."""
    from hoigs.core.clip_folder.write import write_clip

    write_clip(tiny_clip(), folder)
    return folder
