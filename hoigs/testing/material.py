"""A tiny clip with a moving human, object and camera; also written as a folder."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn
from torch.nn.functional import normalize

from hoigs.core.device import constant
from hoigs.core.interfaces.body import BODY_JOINT_PARTS, BodyModel, BodyOutput, BodySurface
from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.maths.skinning import joint_transforms, skin, transform_points
from hoigs.core.model.entity import Entity
from hoigs.core.model.scene import SceneModel
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import BodyTrack, Clip, FrameStore, ObjectTrack
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import BodyPose, Moment
from hoigs.core.values.tokens import EntityKind, Residual
from hoigs.rasterizers.torch_tiles import TorchRasterizer

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


# A tiny body on SMPL-X's joint tree, with six vertices around each of 52 joints.


# SMPL-X's body joints: pelvis, hips, spine1, knees, spine2, ankles, spine3, feet, neck, collars,
# head, shoulders, elbows, wrists; left before right
SMPLX_PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)
JOINTS = (
    (0, 0, 0), (0.1, -0.1, 0), (-0.1, -0.1, 0), (0, 0.12, 0), (0.1, -0.5, 0), (-0.1, -0.5, 0),
    (0, 0.25, 0), (0.1, -0.9, 0), (-0.1, -0.9, 0), (0, 0.33, 0), (0.1, -0.95, 0.1),
    (-0.1, -0.95, 0.1), (0, 0.5, 0), (0.07, 0.43, 0), (-0.07, 0.43, 0), (0, 0.6, 0),
    (0.18, 0.45, 0), (-0.18, 0.45, 0), (0.45, 0.45, 0), (-0.45, 0.45, 0), (0.7, 0.45, 0),
    (-0.7, 0.45, 0),
)  # fmt: skip
FACES = ((0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5))


class TinyBody(BodyModel):
    """Octahedra around joints, with a skinning weight of 0.2 for the parent; two betas.

    It computes in the dtype of the pose.
    """

    num_betas = 2

    joints: Tensor
    template: Tensor

    def __init__(self) -> None:
        super().__init__()
        places = [torch.tensor(p, dtype=torch.float32) for p in JOINTS]
        parents, parts = list(SMPLX_PARENTS), list(BODY_JOINT_PARTS)
        for wrist, side, part in ((20, 1.0, 8), (21, -1.0, 9)):
            for finger in range(5):
                for bone in range(3):
                    parents.append(wrist if bone == 0 else len(parents) - 1)
                    step = torch.tensor((side * (0.05 + 0.03 * bone), 0, 0.02 * (finger - 2)))
                    places.append(places[wrist] + step)
                    parts.append(part)
        count = len(places)
        self.parents = tuple(parents)
        self.joint_names = tuple(f"joint{i}" for i in range(count))
        joints = torch.stack(places)
        radius = torch.where(torch.arange(count) < 22, 0.05, 0.012)
        corners = torch.cat((torch.eye(3), -torch.eye(3)))[[0, 3, 1, 4, 2, 5]]
        weights = 0.8 * torch.eye(count)
        for joint, parent in enumerate(parents):
            weights[joint, max(parent, 0)] += 0.2
        shifts = 6 * torch.arange(count)[:, None, None]
        for name, value in {
            "joints": joints,
            "template": (joints[:, None] + radius[:, None, None] * corners).flatten(0, 1),
            "faces": (torch.tensor(FACES) + shifts).flatten(0, 1),
            "skinning_weights": weights.repeat_interleave(6, 0),
            "vertex_parts": torch.tensor(parts).repeat_interleave(6),
        }.items():
            self.register_buffer(name, value, persistent=False)

    def shaped(
        self, betas: Float[Tensor, "*batch B"]
    ) -> tuple[Float[Tensor, "*batch V 3"], Float[Tensor, "*batch J 3"]]:
        taller = constant((0.0, 1.0, 0.0), like=betas)
        size = (1 + 0.1 * betas[..., :1] + 0.1 * betas[..., 1:2] * taller)[..., None, :]
        return self.template.to(betas) * size, self.joints.to(betas) * size

    def skinning_transforms(self, pose: BodyPose) -> Float[Tensor, "*batch J 4 4"]:
        joints = self.shaped(pose.betas.to(pose.transl))[1]
        return joint_transforms(self.joint_rotations(pose), joints, self.parents, pose.transl)

    def forward(self, pose: BodyPose) -> BodyOutput:
        transforms = self.skinning_transforms(pose)
        vertices, joints = self.shaped(pose.betas.to(pose.transl))
        weights = self.skinning_weights.to(pose.transl)
        return BodyOutput(skin(vertices, transforms, weights), transform_points(transforms, joints))

    def surface(
        self, count: int | None = None, betas: Float[Tensor, " B"] | None = None, seed: int = 0
    ) -> BodySurface:
        """`count` random points, or one for each vertex."""
        betas = self.template.new_zeros(2) if betas is None else betas.to(self.template)
        vertices = self.shaped(betas)[0]
        if count is None:
            owner = torch.arange(len(vertices))
            faces = (self.faces[:, :, None] == owner).any(1).int().argmax(0)
            barycentric = (self.faces[faces] == owner[:, None]).to(vertices)
        else:
            generator = torch.Generator().manual_seed(seed)
            faces = torch.randint(len(self.faces), (count,), generator=generator)
            barycentric = torch.rand(count, 3, generator=generator) + 0.01
            barycentric = (barycentric / barycentric.sum(-1, keepdim=True)).to(vertices)
        corners = self.faces[faces]
        a, b, c = vertices[corners].unbind(1)
        points = (vertices[corners] * barycentric[..., None]).sum(1)
        nearest = corners.gather(1, barycentric.argmax(1, keepdim=True)).squeeze(1)
        return BodySurface(
            points=points,
            normals=normalize(torch.linalg.cross(b - a, c - a), dim=-1),
            spacing=torch.full_like(points[:, 0], 0.03),
            weights=(self.skinning_weights[corners] * barycentric[..., None]).sum(1),
            parts=self.vertex_parts[nearest],
            faces=faces,
            barycentric=barycentric,
        )


# A deformation that provides everything that feature extractors may use.


class TinyMotion(DeformationModel):
    """Every Gaussian moves on its own; a field on the tiny body, and tangents at five keyframes."""

    provides = frozenset({"velocity", "field"})
    per_gaussian = ("tangents",)
    input_space = "world"
    field_width = 6
    keyframes = 5

    codes: Tensor

    def __init__(self) -> None:
        super().__init__()
        self._body = (TinyBody(),)
        generator = torch.Generator().manual_seed(21)
        codes = torch.randn(len(self._body[0].vertex_parts), self.field_width, generator=generator)
        self.register_buffer("codes", codes)

    def bind(self, canonical: Gaussians) -> None:
        rows = torch.linspace(0.5, 1.0, max(len(canonical), 1))[: len(canonical), None, None]
        knots = torch.linspace(-1.0, 1.0, self.keyframes)[:, None] * torch.tensor((0.3, 0.1, -0.2))
        self.tangents = nn.Parameter((rows * knots).to(canonical.means))

    def forward(
        self, canonical: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        means = canonical.means + self.tangents.mean(1) + self.tangents[:, -1] * moment.time
        if residual is not None and residual.means is not None:
            means = means + residual.means
        return canonical.replace(means=means)

    def velocity(self, canonical: Gaussians, moment: Moment) -> Float[Tensor, "N 3"]:
        return self.tangents[:, -1]

    def posed_field(
        self, canonical: Gaussians, moment: Moment
    ) -> tuple[Float[Tensor, "V D"], Float[Tensor, "V 3"]]:
        places = self._body[0](moment.poses[HUMAN]).vertices
        return self.codes + moment.time, places

    def field_parts(self) -> Int[Tensor, " V"]:
        return self._body[0].vertex_parts


# A scene of both entities, as objectives and exporters get it.

COUNT = 12  # Gaussians of each entity


def tiny_scene(*names: str) -> SceneModel:
    """A human and an object that move, or only these, with colours of degree 1."""
    kinds: dict[str, EntityKind] = {HUMAN: "human", OBJECT: "object"}
    entities = {}
    for seed, (name, kind) in enumerate(kinds.items()):
        generator = torch.Generator().manual_seed(seed)
        points = torch.randn(COUNT, 3, generator=generator) * 0.2 + torch.tensor((0.0, 0.0, 3.0))
        canonical = Gaussians.from_points(points, opacity=0.5, sh_degree=1)
        if name in (names or kinds):
            entities[name] = Entity(canonical, TinyMotion(), kind=kind)
    return SceneModel(entities, rasterizer=TorchRasterizer())
