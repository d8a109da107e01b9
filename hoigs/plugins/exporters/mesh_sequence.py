"""exporter:mesh-sequence: a mesh of each person and object at every moment, for any 3D program."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor

from hoigs.core.config import ComponentConfig
from hoigs.core.maths.nearest import nearest
from hoigs.core.model.exporter import ExportRequest
from hoigs.core.reporting import Progress
from hoigs.core.values.gaussians import Gaussians
from hoigs.plugins.exporters.posed import TurnedExporter, Up, body_motion, world_move


class MeshSequenceConfig(ComponentConfig):
    """Settings of `exporter:mesh-sequence`."""

    file: Literal["ply", "obj", "glb"] = "ply"
    """format of the meshes"""
    up: Up = "y"
    """the axis that points upward; "clip" leaves the world as the cameras have it"""
    opacity: float = Field(default=0.3, gt=0, lt=1)
    """Gaussians of an object fainter than this are not part of its surface"""
    alpha: float = Field(default=3.0, gt=0)
    """size of the gaps that an object's surface closes, in distances of neighbouring Gaussians"""


class MeshSequenceExporter(TurnedExporter):
    """`NAME/frame_0000.ply` …, the same triangles at every moment.

    A person is the body model's mesh; an object is the alpha shape (Edelsbrunner & Mücke 1994) of
    its Gaussians at the first moment, whose corners move with them. Colours are those of the
    nearest Gaussians.
    """

    Config: ClassVar = MeshSequenceConfig
    config: MeshSequenceConfig
    kinds: ClassVar = frozenset({"human", "object"})
    keeps: ClassVar = {
        "people": "the body model's mesh", "objects": "the alpha shape of their Gaussians",
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
            found = self._person(request, name) if person else self._object(request, name)
            if found is None:
                lost[name] = "its Gaussians enclose no volume; raise alpha or lower opacity"
                continue
            (folder / name).mkdir()
            moments, faces, colors = found
            for i, vertices in enumerate(moments):
                path = folder / name / f"frame_{i:04d}.{self.config.file}"
                path.write_bytes(mesh_bytes(move.points(vertices), faces, colors, self.config.file))
        return lost

    def _person(
        self, request: ExportRequest, name: str
    ) -> tuple[Float[Tensor, "F V 3"], Int[Tensor, "T 3"], Float[Tensor, "V 3"]]:
        motion = body_motion(request, name)
        with torch.no_grad():
            moments = torch.stack([motion.vertices(i) for i in range(len(motion))])
            gaussians = request.scene(request.moments[0], [name]).gaussians[name]
        seen = _opaque(gaussians, self.config.opacity)
        near = nearest(moments[0], 3, seen.means.cpu())[0]
        return moments, motion.body.faces, seen.colors.cpu().clamp(0, 1)[near].mean(1)

    def _object(
        self, request: ExportRequest, name: str
    ) -> tuple[Float[Tensor, "F V 3"], Int[Tensor, "T 3"], Float[Tensor, "V 3"]] | None:
        states = [request.scene(m, [name]).gaussians[name].to("cpu") for m in request.moments]
        rows = torch.arange(len(states[0]))
        seen = states[0].opacities > self.config.opacity
        rows = rows[seen] if bool(seen.any()) else rows
        faces = alpha_shape(states[0].means[rows], self.config.alpha)
        if len(faces) == 0:
            return None
        used, corners = torch.unique(faces, return_inverse=True)
        rows = rows[used]
        moments = torch.stack([state.means[rows] for state in states])
        return moments, corners, states[0].colors[rows].clamp(0, 1)


def _opaque(gaussians: Gaussians, opacity: float) -> Gaussians:
    seen = gaussians.opacities > opacity
    return gaussians[seen] if bool(seen.any()) else gaussians


def alpha_shape(points: Float[Tensor, "N 3"], alpha: float) -> Int[Tensor, "T 3"]:
    """Triangles around the tetrahedra of the Delaunay triangulation that are small enough.

    They face outward. Empty where no tetrahedron is small enough.

    Args:
        alpha: largest radius of a tetrahedron's circumsphere, in mean distances of neighbours.
    """
    from scipy.spatial import Delaunay, QhullError

    array = points.double().numpy()
    if len(array) < 5:
        return torch.zeros(0, 3, dtype=torch.int64)
    try:
        cells = Delaunay(array).simplices
    except QhullError:  # all in one plane
        return torch.zeros(0, 3, dtype=torch.int64)
    limit = alpha * float(nearest(points, 3)[1].mean())
    cells = cells[_circumradii(array[cells]) < limit]
    sides = np.concatenate([np.delete(cells, k, 1) for k in range(4)])
    inner = np.concatenate([cells[:, k] for k in range(4)])
    _, first, count = np.unique(np.sort(sides, 1), axis=0, return_index=True, return_counts=True)
    outside = first[count == 1]
    faces, behind = sides[outside], inner[outside]
    a, b, c = (array[faces[:, k]] for k in range(3))
    inward = (np.cross(b - a, c - a) * (array[behind] - a)).sum(1) > 0
    faces[inward] = faces[inward][:, ::-1]
    return torch.from_numpy(np.ascontiguousarray(faces, dtype=np.int64))


def _circumradii(cells: np.ndarray) -> np.ndarray:
    """Radius of the sphere through the corners of each tetrahedron [N, 4, 3]."""
    edges = cells[:, 1:] - cells[:, :1]
    volumes = np.abs(np.linalg.det(edges))
    flat = volumes < 1e-18
    edges = np.where(flat[:, None, None], np.eye(3), edges)
    centers = np.linalg.solve(edges, 0.5 * (edges**2).sum(-1, keepdims=True))[..., 0]
    radii: np.ndarray = np.where(flat, np.inf, np.linalg.norm(centers, axis=1))
    return radii


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
