"""initializer:mesh and initializer:points: shapes of other tools, aligned to the clip."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.initializer import ObjectInitializer
from hoigs.core.values.clip import Clip, ObjectTrack
from hoigs.core.values.gaussians import SH_C0
from hoigs.plugins.initializers.alignment import AlignmentConfig, align, inliers

# Shapes of other tools, read by trimesh: point clouds, splats and meshes with their colours.

POINT_FILES = (".ply", ".glb", ".gltf", ".obj", ".xyz", ".off", ".stl")
MESH_FILES = (".ply", ".glb", ".gltf", ".obj", ".off", ".stl")
Shape = tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]


def read_points(path: Path, min_opacity: float = 0.05) -> Shape:
    """Points of a file and their colours, RGB in [0, 1]; grey where it has none.

    PLY (ascii or binary; with `red green blue`, or the `f_dc_*` and `opacity` of 3DGS, whose
    Gaussians fainter than `min_opacity` are left out), glTF, OBJ, XYZ. Of a mesh, its vertices.

    Raises:
        HoigsError: the file is absent, damaged, holds no points, or some that are not finite.
    """
    parts = [_points_of(part, min_opacity) for part in _load(path, POINT_FILES)]
    points, colors = (np.concatenate([p[k] for p in parts] or [np.zeros((0, 3))]) for k in (0, 1))
    if len(points) == 0:
        raise HoigsError(f"{path} is not a point cloud: it holds no points")
    _require_finite(points, path)
    return _tensor(points), _tensor(colors).clamp(0, 1)


def sample_mesh(path: Path, count: int, seed: int = 0) -> Shape:
    """Points spread evenly over the area of a mesh, with the colours of texture, vertices or faces.

    Raises:
        HoigsError: the file is absent, damaged, has no faces, or vertices that are not finite.
    """
    import trimesh

    meshes = [m for m in _load(path, MESH_FILES) if isinstance(m, trimesh.Trimesh)]
    meshes = [m for m in meshes if len(m.faces)]
    for mesh in meshes:
        _require_finite(mesh.vertices, path)
    areas = np.array([m.area for m in meshes])
    if not areas.sum() > 0:
        raise HoigsError(
            f"{path} is not a mesh: it has no faces with an area; initializer:points takes "
            "point clouds"
        )
    ends = np.round(np.cumsum(areas) / areas.sum() * count).astype(int)
    points, colors = [], []
    for mesh, number in zip(meshes, np.diff(ends, prepend=0).tolist(), strict=True):
        if number:
            where, faces = trimesh.sample.sample_surface(mesh, number, seed=seed)[:2]
            points.append(np.asarray(where))
            colors.append(_surface_colors(mesh, where, faces))
    return _tensor(np.concatenate(points)), _tensor(np.concatenate(colors)).clamp(0, 1)


def _load(path: Path, suffixes: tuple[str, ...]) -> list[Any]:
    """The geometries of a file, each where its scene puts it; nothing is read from the network."""
    import trimesh

    if not path.is_file():
        there = [p.name for p in path.parent.glob("*")] if path.parent.is_dir() else []
        raise HoigsError(f"{path}: no such file{did_you_mean(path.name, there)}")
    if path.suffix.lower() not in suffixes:
        raise HoigsError(f"{path}: cannot be read; expected one of {', '.join(suffixes)}")
    try:
        loaded = trimesh.load(path, process=False, allow_remote=False)
        parts: list[Any] = list(loaded.dump()) if isinstance(loaded, trimesh.Scene) else [loaded]
        for part in parts:
            points = np.asarray(getattr(part, "vertices", np.zeros((0, 3))))
            if points.ndim != 2 or points.shape[1] != 3:
                raise ValueError(f"its vertices have the shape {list(points.shape)}")
            faces = getattr(part, "faces", np.zeros((0, 3), int))
            if len(faces) and not 0 <= faces.min() <= faces.max() < len(points):
                raise ValueError("its faces name vertices that are not there")
    except Exception as error:  # its readers raise anything on a damaged file
        reason = f"{type(error).__name__}: {error}"
        raise HoigsError(f"{path} is damaged, or no {path.suffix} file: {reason}") from error
    return parts


def _points_of(part: Any, min_opacity: float) -> tuple[np.ndarray, np.ndarray]:
    points = np.asarray(getattr(part, "vertices", np.zeros((0, 3))), float).reshape(-1, 3)
    raw = part.metadata.get("_ply_raw", {}).get("vertex", {})
    fields, values = raw.get("properties", {}), raw.get("data")
    if "f_dc_2" in fields:
        looks = np.stack([np.asarray(values[f"f_dc_{k}"]).reshape(-1) for k in range(3)], -1)
        colors = 0.5 + SH_C0 * looks.astype(float)
    else:
        colors = _vertex_colors(part)
    if "f_dc_2" in fields and "opacity" in fields:
        logits = np.asarray(values["opacity"], float).reshape(-1)
        seen = ~(logits < np.log(min_opacity / (1 - min_opacity)))  # NaN is reported later
        points, colors = points[seen], colors[seen]
    return points, colors


def _vertex_colors(part: Any) -> np.ndarray:
    """RGB in [0, 1] of a point cloud or of a mesh's vertices; grey without any."""
    count = len(getattr(part, "vertices", ()))
    if hasattr(part, "faces"):
        visual = part.visual
        if visual.kind == "texture":
            visual = visual.to_color()
        colors = visual.vertex_colors if visual.defined else np.zeros(0)
    else:
        colors = getattr(part, "colors", np.zeros(0))
    if len(colors) != count or count == 0:
        return np.full((count, 3), 0.5)
    return np.asarray(colors)[:, :3] / 255.0


def _surface_colors(mesh: Any, points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    import trimesh

    visual = mesh.visual
    if not visual.defined:
        return np.full((len(points), 3), 0.5)
    if visual.kind == "face":
        return np.asarray(visual.face_colors)[faces, :3] / 255.0
    weights = trimesh.triangles.points_to_barycentric(mesh.triangles[faces], points)
    corners = mesh.faces[faces]
    if visual.kind != "texture":
        corner_colors = np.asarray(visual.vertex_colors)[corners, :3] / 255.0
        return (corner_colors * weights[..., None]).sum(1)
    if visual.uv is None:
        return np.tile(np.asarray(visual.material.main_color)[:3] / 255.0, (len(points), 1))
    uv = (np.asarray(visual.uv)[corners] * weights[..., None]).sum(1)
    return np.asarray(visual.material.to_color(uv)).reshape(-1, 4)[:, :3] / 255.0


def _require_finite(points: np.ndarray, path: Path) -> None:
    bad = int((~np.isfinite(points)).any(1).sum())
    if bad:
        raise HoigsError(
            f"{path}: {bad} of {len(points)} points are NaN or infinite; remove them from the file"
        )


def _tensor(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))


class MeshInitializerConfig(AlignmentConfig):
    """Settings of `initializer:mesh`."""

    path: Path = Field(description="a .ply, .glb, .gltf, .obj, .off or .stl file with faces")
    count: int = Field(default=20_000, ge=4, description="number of points on its surface")
    scale_quantile: float = Field(default=0.0, ge=0, lt=0.5, description="a mesh has no strays")


class MeshInitializer(ObjectInitializer):
    """Points spread evenly over a mesh, coloured by its texture, vertices or faces.

    Raises:
        HoigsError: at `initialize`, a file that is absent, damaged or no mesh.
    """

    Config: ClassVar = MeshInitializerConfig
    config: MeshInitializerConfig

    def __init__(self, config: MeshInitializerConfig, *, seed: int = 0) -> None:
        super().__init__(config)
        self.seed = seed

    @classmethod
    def from_config(cls, config: Any, context: BuildContext) -> Self:
        return cls(config, seed=context.seed)

    def initialize(self, clip: Clip, entity: str) -> ObjectTrack:
        path, count = self.config.path, self.config.count
        points, colors = sample_mesh(path, count, self.seed)
        why = f"{count} points on the mesh {path.name}"
        return align(points, colors, clip, entity, self.config, provenance=why)


# initializer:points: the points of any generator or of MASt3R, aligned to the clip.
#
# HOIGS, Sec. "Object Initialization", takes canonical points from a generator, scales them by S and
# transforms them to the world. The generator is the user's choice.


class PointsInitializerConfig(AlignmentConfig):
    """Settings of `initializer:points`."""

    path: Path = Field(description="a .ply, .glb, .gltf, .obj, .xyz, .off or .stl file")
    min_opacity: float = Field(
        default=0.05, gt=0, lt=1, description="fainter Gaussians of a 3DGS .ply are left out"
    )
    outliers: float | None = Field(
        default=None,
        gt=1,
        description="remove outliers, as initializer:depth does; null keeps all",
    )


class PointsInitializer(ObjectInitializer):
    """Points of a file, aligned by the scale S and the world transform.

    Raises:
        HoigsError: at `initialize`, a file that is absent, damaged, empty or not finite.
    """

    Config: ClassVar = PointsInitializerConfig
    config: PointsInitializerConfig

    def initialize(self, clip: Clip, entity: str) -> ObjectTrack:
        points, colors = read_points(self.config.path, self.config.min_opacity)
        if self.config.outliers is not None:
            kept = inliers(points, ratio=self.config.outliers)
            points, colors = points[kept], colors[kept]
        why = f"points of {self.config.path.name}"
        return align(points, colors, clip, entity, self.config, provenance=why)
