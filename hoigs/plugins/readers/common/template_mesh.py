"""Object templates: points on a mesh, about the point that the data set's poses are about."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.errors import ClipError


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
