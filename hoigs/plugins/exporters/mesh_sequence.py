"""exporter:mesh-sequence: a mesh of each person and object at every moment, for any 3D program."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from torch import Tensor

from hoigs.core.config import ComponentConfig
from hoigs.core.maths.nearest import nearest
from hoigs.core.model.exporter import ExportRequest
from hoigs.core.reporting import Progress
from hoigs.plugins.exporters.posed import (
    SEEN,
    TurnedExporter,
    Up,
    body_motion,
    object_motion,
    world_move,
)
from hoigs.plugins.exporters.surfaces import motion_surface


class MeshSequenceConfig(ComponentConfig):
    """Settings of `exporter:mesh-sequence`."""

    file: Literal["ply", "obj", "glb"] = "ply"
    """format of the meshes"""
    up: Up = "y"
    """the axis that points upward; "clip" leaves the world as the cameras have it"""


class MeshSequenceExporter(TurnedExporter):
    """`NAME/frame_0000.ply` …, the same triangles at every moment.

    A person is the body model's mesh; an object is the closed surface through its Gaussians
    (`surfaces`), moved rigidly. Colours are those of the nearest Gaussians.
    """

    Config: ClassVar = MeshSequenceConfig
    config: MeshSequenceConfig
    kinds: ClassVar = frozenset({"human", "object"})
    keeps: ClassVar = {
        "people": "the body model's mesh", "objects": "closed surfaces through their Gaussians",
        "colours": "of the nearest Gaussians at the first moment, a vertex each",
        "triangles": "the same at every moment",
    }  # fmt: skip

    def write(self, request: ExportRequest, folder: Path, progress: Progress) -> Mapping[str, str]:
        lost = {"looks": "a mesh has one colour a vertex, from all sides; ply-sequence holds them"}
        move = world_move(request.clip, self.config.up)
        for done, name in enumerate(request.entities):
            if request.scene.entity(name).kind not in self.kinds:
                continue
            progress(done / len(request.entities), name)
            person = request.scene.entity(name).kind == "human"
            if person and name not in request.bodies:
                lost[name] = "it has no body model"
                continue
            found = _person(request, name) if person else _object(request, name, lost)
            if found is None:
                continue
            (folder / name).mkdir()
            moments, faces, colors = found
            for i, vertices in enumerate(moments):
                path = folder / name / f"frame_{i:04d}.{self.config.file}"
                path.write_bytes(mesh_bytes(move.points(vertices), faces, colors, self.config.file))
        return lost


Moments = tuple[Float[Tensor, "F V 3"], Int[Tensor, "T 3"], Float[Tensor, "V 3"]]


@torch.no_grad()
def _person(request: ExportRequest, name: str) -> Moments:
    """Vertices at the moments, triangles, and colours."""
    motion = body_motion(request, name)
    moments = torch.stack([motion.vertices(i) for i in range(len(motion))])
    gaussians = request.scene(request.moments[0], [name]).gaussians[name]
    seen = gaussians.opacities > SEEN
    gaussians = gaussians[seen] if bool(seen.any()) else gaussians
    near = nearest(moments[0], 3, gaussians.means.cpu())[0]
    return moments, motion.body.faces, gaussians.colors.cpu().clamp(0, 1)[near].mean(1)


def _object(request: ExportRequest, name: str, lost: dict[str, str]) -> Moments | None:
    """As `_person`, if it encloses a volume; what it is not joins `lost`."""
    motion = object_motion(request, name)
    surface, why = motion_surface(request, motion, 512)
    lost |= why
    if surface is None:
        lost[f"surface of {name}"] = "its Gaussians enclose no volume"
        return None
    vertices = torch.from_numpy(surface.vertices).float()
    moments = vertices @ motion.rotations.mT + motion.translations[:, None]
    colors = torch.from_numpy(surface.vertex_colors()).float()
    return moments, torch.from_numpy(surface.faces), colors


def mesh_bytes(
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "T 3"],
    colors: Float[Tensor, "V 3"],
    file: str,
) -> bytes:
    """A mesh with vertex colours in one of trimesh's formats."""
    mesh = trimesh.Trimesh(
        vertices.double().numpy(), faces.numpy(), process=False,
        vertex_colors=np.round(colors.numpy() * 255).astype(np.uint8),
    )  # fmt: skip
    data = mesh.export(file_type=file)
    return data.encode() if isinstance(data, str) else bytes(data)
