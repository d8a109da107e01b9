"""Cameras and bodies of data sets: OpenGL to OpenCV axes, checked rotations, body models by key."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from hoigs.core.errors import ClipError
from hoigs.core.interfaces.body import BodyModel
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.registry.registry import default_registry

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
