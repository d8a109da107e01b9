"""Points and poses that readers share: scenes, object templates, cameras, bodies."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.errors import ClipError
from hoigs.core.interfaces.body import BodyModel
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.registry.registry import default_registry
from hoigs.core.system.npz import load_array
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import FrameStore

Points = tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]
SOURCES = 8  # frames that are read
FARTHEST = 1e7  # metres, as in clip folders


def points_in_box(count: int, reach: float) -> Points:
    """Grey points at random, with coordinates between -reach and reach."""
    places = np.random.default_rng(0).uniform(-reach, reach, (count, 3))
    points = torch.from_numpy(places).float()
    return points, torch.full_like(points, 0.5)


def points_of_depth(
    store: FrameStore,
    cameras: Sequence[Camera],
    entities: Sequence[str],
    count: int = 20_000,
    seed: int = 0,
) -> Points | None:
    """Scene pixels of a few frames, back-projected; world metres and RGB in [0, 1].

    Returns:
        None if no scene pixel of those frames has a depth.
    """
    rng = np.random.default_rng(seed)
    sources = _sources(len(cameras))
    parts = []
    for position in sources:
        depth = store.depth(position)
        if depth is not None:
            where = _scene(store, entities, position, depth.shape) & (depth > 0)
            share = -(-count // len(sources))
            parts.append(_lifted(store, cameras, position, where, depth, share, rng))
    points, colors = (torch.cat(x) for x in zip(*parts)) if parts else (torch.zeros(0, 3),) * 2
    return (points, colors) if len(points) else None


def points_along_rays(
    store: FrameStore,
    cameras: Sequence[Camera],
    entities: Sequence[str],
    span: tuple[float, float],
    count: int = 20_000,
    seed: int = 0,
) -> Points:
    """Points at random depths behind the scene's pixels, with their colours: a start where nothing
    is known of the scene's shape; training moves them.

    Args:
        span: nearest and farthest depth, metres; inverse depth is uniform between them.

    Raises:
        ClipError: the span makes no sense, since the cameras or what they look at do not.
    """
    if not 1 / FARTHEST < span[0] <= span[1] < FARTHEST:
        raise ClipError(
            f"the scene would begin {span[0]:.3g} to {span[1]:.3g} m away from the cameras: their "
            "poses, or what places the scene, are wrong"
        )
    rng = np.random.default_rng(seed)
    sources = _sources(len(cameras))
    parts = []
    for position in sources:
        camera = cameras[position]
        where = _scene(store, entities, position, (camera.height, camera.width))
        inverse = rng.uniform(1 / span[1], 1 / span[0], where.shape)
        depth = torch.from_numpy(1 / inverse).float()
        share = -(-count // len(sources))
        parts.append(_lifted(store, cameras, position, where, depth, share, rng))
    points, colors = (torch.cat(x) for x in zip(*parts))
    return points, colors


def _sources(frames: int) -> list[int]:
    spread = np.linspace(0, frames - 1, min(SOURCES, frames)).round().astype(int)
    return sorted(set(spread.tolist()))


def _scene(
    store: FrameStore, entities: Sequence[str], position: int, shape: tuple[int, ...]
) -> Tensor:
    """Scene pixels: those that neither belong to an entity nor are ignored."""
    taken = torch.zeros(shape, dtype=torch.bool)
    for name in entities:
        taken |= store.mask(name, position)
    ignored = store.ignored(position)
    return ~taken if ignored is None else ~(taken | ignored)


def _lifted(
    store: FrameStore,
    cameras: Sequence[Camera],
    position: int,
    where: Tensor,
    depth: Tensor,
    count: int,
    rng: np.random.Generator,
) -> Points:
    rows = np.flatnonzero(where.numpy())
    chosen = torch.from_numpy(rng.choice(rows, min(count, len(rows)), replace=False))
    camera = cameras[position]
    grid = camera.pixel_grid().reshape(-1, 2)[chosen]
    points = camera.unproject(grid, depth.reshape(-1)[chosen])
    return points, store.image(position).reshape(-1, 3)[chosen].float() / 255


# Scene points of a PLY or .npy file.

GREY = 0.5  # of points whose file has no colours


def read_points(path: Path) -> Points:
    """Points, and RGB in [0, 1] (grey where the file has none).

    Colours of a PLY are 0..255 whatever their type: 3DGS's writers store them as floats.

    Raises:
        ClipError: it cannot be read, or holds no points.
    """
    try:
        points, colors = _npy(path) if path.suffix == ".npy" else _ply(path)
    except (OSError, ValueError, KeyError, IndexError) as error:
        raise ClipError(f"{path} cannot be read as points ({error}); write it again") from error
    keep = np.isfinite(points).all(-1)
    if points.ndim != 2 or points.shape[1] != 3 or not keep.any():
        raise ClipError(f"{path} has shape {list(points.shape)}, expected some points [P, 3]")
    return torch.from_numpy(points[keep]).float(), torch.from_numpy(colors[keep]).float()


def _npy(path: Path) -> tuple[np.ndarray, np.ndarray]:
    points = load_array(path)
    if not np.can_cast(points.dtype, np.float64, "same_kind"):
        raise ValueError(f"expected numbers, got {points.dtype}")
    points = points.astype(np.float64)
    return points, np.full_like(points, GREY)


def _ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    loaded: Any = trimesh.load(path, process=False)
    # trimesh assumes that float colours are in 0..1, so the raw values are read
    table = loaded.metadata["_ply_raw"]["vertex"]["data"]
    points = np.asarray(loaded.vertices, np.float64)
    named = table.dtype.names if isinstance(table, np.ndarray) else tuple(table)
    if not {"red", "green", "blue"} <= set(named):
        return points, np.full_like(points, GREY)
    channels = [np.asarray(table[c], np.float64).reshape(-1) for c in ("red", "green", "blue")]
    return points, np.clip(np.stack(channels, -1) / 255, 0, 1)


# Object templates: points on a mesh, about the point that the data set's poses are about.


def load_mesh(path: Path) -> Any:
    """A trimesh with the vertices of the file, in its order: none merged, none moved.

    Raises:
        ClipError: it cannot be read, or has no vertices.
    """
    import trimesh

    try:
        loaded: Any = trimesh.load(
            path, process=False, maintain_order=True, allow_remote=False, force="mesh"
        )
        vertices = np.asarray(loaded.vertices, np.float64)
    except Exception as error:  # its readers raise anything on a damaged file
        raise ClipError(f"{path} is not a mesh ({type(error).__name__}: {error})") from error
    if vertices.ndim != 2 or vertices.shape[1] != 3 or not len(vertices):
        raise ClipError(f"{path} is not a mesh: it has no vertices of three coordinates")
    if not np.isfinite(vertices).all():
        raise ClipError(f"{path} is not a mesh: some of its vertices are not finite")
    faces = np.asarray(loaded.faces)
    if faces.size and not 0 <= faces.min() <= faces.max() < len(vertices):
        raise ClipError(f"{path} is not a mesh: some of its faces name a vertex that it lacks")
    return loaded


def sample_template(
    path: Path, count: int, seed: int = 0
) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
    """Points spread over a mesh, about the mean of its vertices, and RGB in [0, 1].

    The mean is of the vertices as the file has them: merging equal ones would move it.

    Raises:
        ClipError: as `load_mesh`, or it has no faces.
    """
    import trimesh

    mesh = load_mesh(path)
    if not len(mesh.faces):
        raise ClipError(f"{path} has no faces; expected the object's template mesh")
    center = np.asarray(mesh.vertices, np.float64).mean(0)
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=seed)[:2]
    colors = np.full((count, 3), 0.5)
    if mesh.visual.kind == "vertex":
        weights = trimesh.triangles.points_to_barycentric(mesh.triangles[faces], points)
        corners = np.asarray(mesh.visual.vertex_colors)[mesh.faces[faces], :3] / 255
        colors = (corners * weights[..., None]).sum(1).clip(0, 1)
    about = np.asarray(points, np.float64) - center
    return torch.from_numpy(about).float(), torch.from_numpy(colors).float()


# Cameras and bodies of data sets: OpenGL to OpenCV axes, checked rotations, body models by key.

ROTATION_TOLERANCE = 1e-3  # of R R^T - I: files have few digits
Array = np.ndarray


def opengl_to_world_to_camera(
    camera_to_world: Float[Array, "4 4"], where: str
) -> Float[Array, "4 4"]:
    """World-to-camera with OpenCV axes (y down, z forward) of a camera-to-world with OpenGL axes
    (y up, z backward), as Blender and nerfstudio write them.

    Args:
        where: names the camera in errors.

    Raises:
        ClipError: it is not rigid.
    """
    rotation = checked_rotation(camera_to_world[:3, :3], where) * [1.0, -1.0, -1.0]
    return rigid(rotation.T, -rotation.T @ camera_to_world[:3, 3])


def rigid(rotation: Float[Array, "3 3"], shift: Float[Array, " 3"]) -> Float[Array, "4 4"]:
    """x -> R x + t as one matrix, float64."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, shift
    return matrix


def checked_rotation(matrix: Float[Array, "3 3"], where: str) -> Float[Array, "3 3"]:
    """The rotation, or an error.

    Raises:
        ClipError: it is not a rotation: sheared, scaled, mirrored or not finite.
    """
    R = np.asarray(matrix, np.float64)
    off = np.abs(R @ R.T - np.eye(3)).max() if np.isfinite(R).all() else np.inf
    if off > ROTATION_TOLERANCE or np.linalg.det(R) < 0:
        raise ClipError(
            f"{where}: the rotation is not orthonormal with determinant +1 (largest |R R^T - I| "
            f"is {off:.3g}, determinant {np.linalg.det(R):.3g}); export cameras without scale"
        )
    return R


def body_model(key: str, path: Path, **settings: Any) -> BodyModel:
    """The body model of a registry key, from the user's file."""
    registry = default_registry()
    config = registry.config_class(key)(path=path, **settings)
    return registry.concrete(key).from_config(config, BuildContext())
