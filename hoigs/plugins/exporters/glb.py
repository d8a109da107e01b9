"""exporter:gltf-splat and exporter:gltf-body: binary glTF 2.0 of Gaussians, people and objects."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from hoigs.core.config import ComponentConfig
from hoigs.core.maths.rotations import axis_angle_to_quats, matrices_to_quats
from hoigs.core.maths.skinning import skin
from hoigs.core.model.exporter import Exporter, ExportRequest
from hoigs.core.reporting import Progress
from hoigs.core.values.between import camera_between, frame_of
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.plugins.exporters.carried import at_rest
from hoigs.plugins.exporters.posed import (
    AXES,
    BodyMotion,
    ObjectMotion,
    body_motion,
    object_motions,
    world_move,
)
from hoigs.plugins.exporters.surfaces import Surface, body_surface, motion_surface

COMPONENTS = {
    "float32": 5126, "uint32": 5125, "uint16": 5123, "int16": 5122, "uint8": 5121, "int8": 5120,
}  # fmt: skip
SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
VERTICES, INDICES = 34962, 34963  # what a buffer view is for


class Glb:
    """A glTF document that grows: `add` appends to a list and gives the index, `accessor` stores
    an array.
    """

    def __init__(self) -> None:
        self.document: dict[str, Any] = {"asset": {"version": "2.0", "generator": "hoigs"}}
        self._data = bytearray()

    def add(self, kind: str, **entry: Any) -> int:
        """Append to the list `kind` ("nodes", "meshes" …) and give the index of the entry."""
        entries: list[dict[str, Any]] = self.document.setdefault(kind, [])
        entries.append(entry)
        return len(entries) - 1

    def accessor(
        self, array: np.ndarray, target: int | None = None, *, normalized: bool = False
    ) -> int:
        """Store an array [N] or [N, k]; gives the index of its accessor.

        Args:
            target: VERTICES or INDICES for what a mesh reads; of the former each row begins at a
                multiple of four bytes.
            normalized: integers stand for [0, 1], signed ones for [-1, 1].
        """
        width = 1 if array.ndim == 1 else int(np.prod(array.shape[1:]))
        array = np.ascontiguousarray(array).reshape(len(array), width)
        view: dict[str, Any] = {}
        flat, row = array, width * array.itemsize
        if target == VERTICES and row % 4:
            array = np.pad(array, ((0, 0), (0, -row % 4 // array.itemsize)))
            view["byteStride"] = array.shape[1] * array.itemsize
        if target is not None:
            view["target"] = target
        entry: dict[str, Any] = {
            "bufferView": self.view(array.tobytes(), **view),
            "componentType": COMPONENTS[flat.dtype.name],
            "count": len(flat),
            "type": SHAPES[width],
        }
        if normalized:
            entry["normalized"] = True
        if width <= 4:
            entry["min"], entry["max"] = flat.min(0).tolist(), flat.max(0).tolist()
        return self.add("accessors", **entry)

    def view(self, data: bytes, **entry: Any) -> int:
        """Store bytes; gives the index of their buffer view."""
        place = {"buffer": 0, "byteOffset": len(self._data), "byteLength": len(data)}
        self._data += data + b"\0" * (-len(data) % 4)
        return self.add("bufferViews", **place, **entry)

    def zeros(self, count: int) -> int:
        """The accessor of positions that are all zero, which takes no room."""
        entry = {"componentType": COMPONENTS["float32"], "count": count, "type": "VEC3"}
        return self.add("accessors", **entry, min=[0.0] * 3, max=[0.0] * 3)

    def whole(self) -> bytes:
        """The file."""
        if self._data:
            self.document["buffers"] = [{"byteLength": len(self._data)}]
        text = json.dumps(self.document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
        chunks += struct.pack("<II", len(self._data), 0x004E4942) + bytes(self._data)
        return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks


# exporter:gltf-splat: the Gaussians of one moment as glTF's KHR_gaussian_splatting.

NAME = "KHR_gaussian_splatting"
KERNEL = {
    "kernel": "ellipse", "colorSpace": "srgb_rec709_display",
    "sortingMethod": "cameraDistance", "projection": "perspective",
}  # fmt: skip


class GltfSplatExporter(Exporter):
    """`splats.glb`: one point primitive for each entity.

    It is written as the release candidate and the ratified text of the extension have it, with
    scales in metres; drafts before had their logarithms. Few programs read it yet.
    """

    suffixes = (".glb",)
    moving: ClassVar = False
    up = "y"
    axes = AXES["y"]
    keeps: ClassVar = {
        "means": "POSITION", "rotations": "unit quaternions xyzw", "opacities": "in [0, 1]",
        "scales": "standard deviations", "colours": "all SH bands, srgb_rec709_display",
    }  # fmt: skip

    def write(self, request: ExportRequest, folder: Path, progress: Progress) -> Mapping[str, str]:
        progress(0.0, "gaussians")
        move = world_move(request.clip, "y")
        state = request.scene(request.moments[0], request.entities)
        glb = Glb()
        glb.document["extensionsUsed"] = [NAME]
        nodes = []
        for name, gaussians in state.gaussians.items():
            if len(gaussians):
                mesh = add_splats(glb, name, move.gaussians(gaussians))
                nodes.append(glb.add("nodes", name=name, mesh=mesh))
        glb.add("scenes", nodes=nodes)
        glb.document["scene"] = 0
        progress(0.5, "writing")
        (folder / "splats.glb").write_bytes(glb.whole())
        lost = {"support": f"{NAME} is new: programs without it show coloured points"}
        if len(request.moments) > 1:
            lost["motion"] = "the extension holds one moment, the first; usd holds all"
        return lost


def add_splats(glb: Glb, name: str, gaussians: Gaussians) -> int:
    """The mesh of one entity."""
    g = gaussians.detach().to("cpu", torch.float32)
    quats = torch.nn.functional.normalize(g.quats, dim=-1)[:, [1, 2, 3, 0]]
    fallback = torch.cat((g.colors.clamp(0, 1), g.opacities[:, None]), 1)
    fallback[:, :3] = torch.from_numpy(linear_color(fallback[:, :3].numpy()))
    values = {
        "POSITION": g.means,
        "COLOR_0": fallback,
        f"{NAME}:ROTATION": quats,
        f"{NAME}:SCALE": g.scales,
        f"{NAME}:OPACITY": g.opacities,
    }
    for degree in range(g.sh_degree + 1):
        for k in range(2 * degree + 1):
            values[f"{NAME}:SH_DEGREE_{degree}_COEF_{k}"] = g.sh[:, degree * degree + k]
    attributes = {
        key: glb.accessor(value.float().numpy(), VERTICES) for key, value in values.items()
    }
    shape = {"attributes": attributes, "mode": 0, "extensions": {NAME: KERNEL}}
    return glb.add("meshes", name=name, primitives=[shape])


# exporter:gltf-body: skinned people, moving objects and the camera, animated, as binary glTF.

INFLUENCES = 8  # joints that may move a vertex: two sets of four, which glTF players read


class GltfBodyConfig(ComponentConfig):
    """Settings of `exporter:gltf-body`."""

    camera: bool = True
    """the camera of the video, animated"""
    texture: int = Field(default=1024, ge=64, le=8192)
    """pixels of a side of each texture"""


class GltfBodyExporter(Exporter):
    """`body.glb`: each person as a skinned mesh, each object as a mesh on an animated node, closed,
    with normals and a baked texture.
    """

    Config: ClassVar = GltfBodyConfig
    config: GltfBodyConfig
    suffixes = (".glb",)
    kinds: ClassVar = frozenset({"human", "object"})
    up = "y"
    axes = AXES["y"]
    keeps: ClassVar = {
        "people": "skinned meshes in their shape; textures of the mean colours of their Gaussians",
        "objects": "closed meshes through the centres of their Gaussians, textured, moved rigidly",
        "camera": "of the video, with its vertical field of view at the first moment",
    }

    def write(self, request: ExportRequest, folder: Path, progress: Progress) -> Mapping[str, str]:
        glb = Glb()
        seconds = np.arange(len(request.moments), dtype=np.float32) / np.float32(request.fps)
        clock = Clock(glb, glb.accessor(seconds))
        lost = {"looks": "Gaussians are left out; ply-sequence and usd hold them"}
        children, skins = [], []  # what carries a skin stands at the root: its bones place it
        people = request.of_kind("human")
        for i, name in enumerate(people):
            progress(0.8 * i / len(people), name)
            if name not in request.bodies:
                lost[name] = "it has no body model"
                continue
            motion = body_motion(request, name)
            surface = body_surface(motion, at_rest(request, motion), self.config.texture)
            bones, skin = add_person(clock, motion, surface)
            children.append(bones)
            skins.append(skin)
            worst = skinning_error(motion)
            if worst > 1e-4:
                lost[f"surface of {name}"] = (
                    f"glTF's skinning is up to {1000 * worst:.1f} mm from the body model, which "
                    "also corrects its vertices by pose or weighs more joints"
                )
        progress(0.8, "objects")
        for rigid in object_motions(request):
            mesh, why = motion_surface(request, rigid, self.config.texture)
            children.append(add_object(clock, rigid, mesh))
            lost |= why
        if self.config.camera:
            frames = [frame_of(request.clip, moment) for moment in request.moments]
            cameras = [camera_between(request.clip, frame).to("cpu") for frame in frames]
            children.append(add_camera(clock, cameras))
        move = world_move(request.clip, "y")
        root = glb.add(
            "nodes", name="world", rotation=xyzw(matrices_to_quats(move.turn)).tolist(),
            translation=move.shift.tolist(), children=children,
        )  # fmt: skip
        glb.add("scenes", nodes=[root, *skins])
        glb.document["scene"] = 0
        progress(0.9, "writing")
        (folder / "body.glb").write_bytes(glb.whole())
        return lost


class Clock:
    """The one animation of the file, and the accessor of its times."""

    def __init__(self, glb: Glb, times: int) -> None:
        self.glb, self.times = glb, times
        self.animation = glb.add("animations", name="clip", channels=[], samplers=[])

    def move(self, node: int, path: str, values: np.ndarray) -> None:
        """Animate "rotation" or "translation" of a node: one value a moment."""
        entry = self.glb.document["animations"][self.animation]
        output = self.glb.accessor(values.astype(np.float32))
        entry["samplers"].append({"input": self.times, "output": output, "interpolation": "LINEAR"})
        target = {"node": node, "path": path}
        entry["channels"].append({"sampler": len(entry["samplers"]) - 1, "target": target})


def add_bones(clock: Clock, motion: BodyMotion) -> list[int]:
    """The joints of a person, animated: their nodes, the pelvis first."""
    glb, parents = clock.glb, motion.body.parents
    rest = motion.rest_joints.numpy()
    quats = continuous(xyzw(axis_angle_to_quats(motion.rotations)))
    joints: list[int] = []
    for joint, parent in enumerate(parents):
        place = rest[joint] - rest[parent] if parent >= 0 else motion.pelvis[0].numpy()
        entry: dict[str, Any] = {"name": f"{motion.name}.{motion.body.joint_names[joint]}"}
        entry |= {"translation": place.tolist(), "rotation": quats[0, joint].tolist()}
        if parent < 0 and motion.scale != 1.0:
            entry["scale"] = [motion.scale] * 3
        joints.append(glb.add("nodes", **entry))
        if parent >= 0:
            glb.document["nodes"][joints[parent]].setdefault("children", []).append(joints[joint])
        clock.move(joints[joint], "rotation", quats[:, joint])
    clock.move(joints[0], "translation", motion.pelvis.numpy())
    return joints


def add_skin(
    glb: Glb, joints: Sequence[int], motion: BodyMotion, low: float | np.ndarray = 0.0,
    size: float = 1.0,
) -> int:  # fmt: skip
    """The skin of a mesh whose vertices times `size` plus `low` are the body at rest."""
    inverse = np.tile(np.diag(np.array((size, size, size, 1), np.float32)), (len(joints), 1, 1))
    inverse[:, 3, :3] = low - motion.rest_joints.numpy()  # column by column, as glTF has matrices
    bound = glb.accessor(inverse.reshape(-1, 16))
    return glb.add("skins", joints=list(joints), inverseBindMatrices=bound, skeleton=joints[0])


def add_person(clock: Clock, motion: BodyMotion, surface: Surface) -> tuple[int, int]:
    """Joints, skin and mesh of a person; gives the nodes of the pelvis and of the mesh."""
    glb = clock.glb
    joints = add_bones(clock, motion)
    skeleton = add_skin(glb, joints, motion)
    chosen, weights = influences(motion.body.skinning_weights)
    carried = {}
    for k in range(0, chosen.shape[1], 4):
        carried[f"JOINTS_{k // 4}"] = chosen[:, k : k + 4]
        carried[f"WEIGHTS_{k // 4}"] = weights[:, k : k + 4]
    mesh = add_surface(glb, motion.name, surface, carried)
    return joints[0], glb.add("nodes", name=motion.name, mesh=mesh, skin=skeleton)


def add_surface(
    glb: Glb, name: str, surface: Surface, more: Mapping[str, np.ndarray] | None = None
) -> int:
    """The mesh of a surface, with its texture; `more` are attributes of its vertices."""
    rows, faces, uv = surface.split()
    vertices = {"POSITION": surface.vertices, "NORMAL": surface.normals, **(more or {})}
    attributes = {
        key: glb.accessor(_float32(value)[rows], VERTICES) for key, value in vertices.items()
    }
    # glTF's texture coordinates begin on top
    attributes["TEXCOORD_0"] = glb.accessor(_float32(uv * (1, -1) + (0, 1)), VERTICES)
    image = glb.add("images", bufferView=glb.view(surface.png()), mimeType="image/png", name=name)
    paint = {"baseColorTexture": {"index": glb.add("textures", source=image)}}
    matt = {**paint, "metallicFactor": 0.0, "roughnessFactor": 1.0}
    material = glb.add("materials", name=name, pbrMetallicRoughness=matt)
    indices = glb.accessor(faces.astype(np.uint32).reshape(-1), INDICES)
    shape = {"attributes": attributes, "indices": indices, "material": material}
    return glb.add("meshes", name=name, primitives=[shape])


def _float32(values: np.ndarray) -> np.ndarray:
    return values.astype(np.float32) if values.dtype == np.float64 else values


def influences(weights: Float[Tensor, "V J"]) -> tuple[np.ndarray, np.ndarray]:
    """The joints that move each vertex most, and their weights, which sum to one.

    Four or eight of each, as glTF takes them by four.
    """
    count = 4 if bool(((weights > 1e-6).sum(1) <= 4).all()) else INFLUENCES
    found = weights.float().topk(min(count, weights.shape[1]), dim=1)
    kept = (found.values / found.values.sum(1, keepdim=True)).numpy().astype(np.float32)
    joints = np.where(kept > 0, found.indices.numpy(), 0).astype(np.uint8)
    return joints, kept


@torch.no_grad()
def skinning_error(motion: BodyMotion) -> float:
    """How far linear blending of the kept weights is from the body model, metres, at worst."""
    chosen, kept = influences(motion.body.skinning_weights)
    weights = torch.zeros_like(motion.body.skinning_weights)
    weights.scatter_add_(1, torch.from_numpy(chosen.astype(np.int64)), torch.from_numpy(kept))
    vertices = motion.body.shaped(motion.betas)[0]
    worst = 0.0
    for i in range(0, len(motion), max(1, len(motion) // 8)):
        pose = motion.pose(i)
        ours = skin(vertices, motion.body.skinning_transforms(pose), weights)
        theirs = motion.body(pose).vertices
        worst = max(worst, motion.scale * float((ours - theirs).norm(dim=-1).max()))
    return worst


def add_object(clock: Clock, motion: ObjectMotion, surface: Surface | None) -> int:
    """An object's mesh on an animated node; its points, where there is none."""
    glb = clock.glb
    quats = continuous(xyzw(matrices_to_quats(motion.rotations))[:, None])[:, 0]
    if surface is not None:
        mesh = add_surface(glb, motion.name, surface)
    else:
        color = glb.accessor(linear_color(motion.colors.numpy()), VERTICES)
        shape = {"POSITION": glb.accessor(motion.points.numpy(), VERTICES), "COLOR_0": color}
        mesh = glb.add("meshes", name=motion.name, primitives=[{"attributes": shape, "mode": 0}])
    place = motion.translations[0].tolist()
    node = glb.add(
        "nodes", name=motion.name, mesh=mesh, rotation=quats[0].tolist(), translation=place
    )
    clock.move(node, "rotation", quats)
    clock.move(node, "translation", motion.translations.numpy())
    return node


def add_camera(clock: Clock, cameras: Sequence[Camera]) -> int:
    """The camera of the video on an animated node; glTF's looks along -z with y up."""
    glb, first = clock.glb, cameras[0]
    lens = {
        "yfov": 2 * math.atan(first.height / (2 * float(first.K[1, 1]))),
        "aspectRatio": first.width / first.height,
        "znear": 0.05,
    }
    index = glb.add("cameras", type="perspective", perspective=lens, name="video")
    flip = torch.diag(torch.tensor((1.0, -1.0, -1.0)))
    turns = torch.stack([c.world_to_camera[:3, :3].mT @ flip for c in cameras])
    quats = continuous(xyzw(matrices_to_quats(turns))[:, None])[:, 0]
    places = torch.stack([c.center for c in cameras])
    node = glb.add(
        "nodes", name="camera", camera=index, rotation=quats[0].tolist(),
        translation=places[0].tolist(),
    )  # fmt: skip
    clock.move(node, "rotation", quats)
    clock.move(node, "translation", places.numpy())
    return node


def linear_color(colors: np.ndarray) -> np.ndarray:
    """glTF's linear colours of display colours (inverse of the sRGB transfer function)."""
    value = colors.astype(np.float64)
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return linear.astype(np.float32)


def xyzw(quats: Float[Tensor, "*batch 4"]) -> np.ndarray:
    """glTF's order, unit, from wxyz."""
    unit = torch.nn.functional.normalize(quats.double(), dim=-1)
    return unit[..., [1, 2, 3, 0]].numpy().astype(np.float32)


def continuous(quats: np.ndarray) -> np.ndarray:
    """[F, J, 4] with signs such that neighbours in time are near."""
    turned = quats.copy()
    for i in range(1, len(turned)):
        away = (turned[i] * turned[i - 1]).sum(-1) < 0
        turned[i, away] *= -1
    return turned
