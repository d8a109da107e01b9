"""View: the browser's camera, as viser has it, and as our Camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from hoigs.core.maths.rotations import quats_to_matrices
from hoigs.core.values.camera import Camera

Vector = Float[np.ndarray, " 3"]


@dataclass(frozen=True)
class View:
    """A pinhole camera without a size.

    Attributes:
        position, target: the eye, and the point about which it turns, metres.
        rotation: camera to world, OpenCV axes. up: which way a drag keeps upright.
        fov: vertical angle, radians.
    """

    position: Vector
    target: Vector
    rotation: Float[np.ndarray, "3 3"]
    up: Vector
    fov: float

    @staticmethod
    def of_client(camera: Any) -> View:
        """The camera handle of a viser client."""
        turned = quats_to_matrices(torch.as_tensor(np.asarray(camera.wxyz, np.float64)))
        return View(
            np.asarray(camera.position, np.float64), np.asarray(camera.look_at, np.float64),
            turned.numpy(), np.asarray(camera.up_direction, np.float64), float(camera.fov),
        )  # fmt: skip

    @staticmethod
    def of_camera(camera: Camera, distance: float, canvas: tuple[int, int]) -> View:
        """A camera whose whole image fits into a canvas; `distance` to the target, metres."""
        pose = camera.world_to_camera.double().numpy()
        rotation = pose[:3, :3].T
        position = -rotation @ pose[:3, 3]
        scale = min(canvas[0] / camera.width, canvas[1] / camera.height)
        fov = 2 * math.atan(canvas[1] / (2 * scale * float(camera.K[1, 1])))
        target = position + rotation[:, 2] * distance
        return View(position, target, rotation, -rotation[:, 1], fov)

    def camera(self, canvas: tuple[int, int]) -> Camera:
        """Our camera for a canvas of any aspect."""
        width, height = canvas
        focal = height / 2 / math.tan(self.fov / 2)
        K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        pose = torch.eye(4, dtype=torch.float64)
        back = torch.from_numpy(self.rotation.T.copy())
        pose[:3, :3], pose[:3, 3] = back, -back @ torch.from_numpy(self.position)
        return Camera(K.float(), pose.float(), width, height)

    def moved(self, by: Vector) -> View:
        return replace(self, position=self.position + by, target=self.target + by)

    def near(self, other: View, tolerance: float = 1e-3) -> bool:
        """Whether eye and direction agree within a share of the distance to the target."""
        scale = max(float(np.linalg.norm(self.target - self.position)), 1e-6)
        apart = float(np.linalg.norm(self.position - other.position)) / scale
        return apart < tolerance and bool(np.abs(self.rotation - other.rotation).max() < tolerance)

    def apply(self, camera: Any) -> None:
        """Set the camera of a viser client."""
        camera.position, camera.look_at = self.position, self.target
        camera.up_direction, camera.fov = self.up, self.fov
