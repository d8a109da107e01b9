"""TexturedMesh: triangles with corner normals and uv, and the few solids that rooms are made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

Array = np.ndarray


@dataclass(frozen=True)
class TexturedMesh:
    """Triangles, world or object space, metres.

    Attributes:
        normals: unit, one a corner, so that flat and smooth surfaces go the same way.
        uv: texture coordinates of each corner; v runs down the image.
        texture: index into the scene's textures of each face.
    """

    vertices: Float[Array, "V 3"]
    faces: Int[Array, "F 3"]
    normals: Float[Array, "F 3 3"]
    uv: Float[Array, "F 3 2"]
    texture: Int[Array, " F"]

    def moved(
        self,
        rotation: Float[Array, "3 3"] | None = None,
        shift: Sequence[float | int] | Array = (0, 0, 0),
    ) -> TexturedMesh:
        """R x + t of every vertex."""
        rotation = np.eye(3) if rotation is None else rotation
        return replace(
            self,
            vertices=self.vertices @ rotation.T + np.asarray(shift, float),
            normals=self.normals @ rotation.T,
        )

    @staticmethod
    def join(meshes: Sequence[TexturedMesh]) -> TexturedMesh:
        """One mesh of several; textures keep their indices."""
        starts = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
        return TexturedMesh(
            np.concatenate([m.vertices for m in meshes]),
            np.concatenate([m.faces + s for m, s in zip(meshes, starts, strict=True)]),
            np.concatenate([m.normals for m in meshes]),
            np.concatenate([m.uv for m in meshes]),
            np.concatenate([m.texture for m in meshes]),
        )


def quad(corners: Array, texture: int) -> TexturedMesh:
    """A flat rectangle; corners run top-left, top-right, bottom-right, bottom-left as seen."""
    corners = np.asarray(corners, float)
    normal = np.cross(corners[3] - corners[0], corners[1] - corners[0])
    normal /= np.linalg.norm(normal)
    faces = np.array([[0, 2, 1], [0, 3, 2]])
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    return TexturedMesh(
        corners, faces, np.broadcast_to(normal, (2, 3, 3)), uv[faces], np.full(2, texture)
    )


def face_grid(
    origin: Array, right: Array, down: Array, texture: int, columns: int = 1
) -> TexturedMesh:
    """A rectangle cut into `columns` strips, so that it can be bent along `right`."""
    strips = []
    for i in range(columns):
        a, b = i / columns, (i + 1) / columns
        left, far = origin + a * right, origin + b * right
        strip = quad(np.stack((left, far, far + down, left + down)), texture)
        strips.append(replace(strip, uv=strip.uv * [b - a, 1] + [a, 0]))
    return TexturedMesh.join(strips)


def box(size: Sequence[float], textures: int | Sequence[int], columns: int = 1) -> TexturedMesh:
    """An axis-aligned box about the origin.

    Args:
        size: extent along x, y, z.
        textures: one for all, or six for +x, -x, +y, -y, +z, -z.
        columns: strips along x, for a box that bends.
    """
    six = [textures] * 6 if isinstance(textures, int) else list(textures)
    h = np.asarray(size, float) / 2
    x, y, z = np.diag(h)
    sides = ((x, -z, -y, 1), (-x, z, -y, 1), (y, x, z, columns), (-y, x, -z, columns),
             (z, x, -y, columns), (-z, -x, -y, columns))  # fmt: skip
    return TexturedMesh.join(
        [
            face_grid(out - right - down, 2 * right, 2 * down, texture, count)
            for (out, right, down, count), texture in zip(sides, six, strict=True)
        ]
    )


def lathe(profile: Sequence[tuple[float, float]], texture: int, sides: int = 20) -> TexturedMesh:
    """A surface of revolution about y.

    Args:
        profile: (radius, height) pairs from top to bottom; u runs around, v along them.
    """
    radius, height = np.asarray(profile, float).T
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    ring = np.stack((np.sin(angle), np.zeros_like(angle), np.cos(angle)), -1)
    vertices = radius[:, None, None] * ring + height[:, None, None] * np.array([0, 1.0, 0])
    slope_r, slope_y = np.gradient(radius), np.gradient(height)
    normals = -slope_y[:, None, None] * ring + slope_r[:, None, None] * np.array([0, 1.0, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-9)
    along = np.linspace(0, 1, len(profile))
    uv = np.stack(np.broadcast_arrays(angle[None] / (2 * np.pi), along[:, None]), -1)
    grid = np.arange(vertices.shape[0] * vertices.shape[1]).reshape(vertices.shape[:2])
    a, b, c, d = grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]
    faces = np.concatenate((np.stack((a, c, b), -1), np.stack((a, d, c), -1))).reshape(-1, 3)
    vertices, normals, uv = (v.reshape(-1, v.shape[-1]) for v in (vertices, normals, uv))
    return TexturedMesh(vertices, faces, normals[faces], uv[faces], np.full(len(faces), texture))


def cylinder(radius: float, height: float, texture: int, cap: int | None = None) -> TexturedMesh:
    """A closed cylinder on the floor plane, axis y."""
    rim = [(radius, height), (radius, 0.0)]
    lid = lathe([(1e-4, height), (radius, height)], texture if cap is None else cap)
    return TexturedMesh.join([lathe(rim, texture), lid])


def ball(radius: float, texture: int, squash: float = 1.0) -> TexturedMesh:
    """A sphere about the origin, `squash` times as high."""
    angle = np.linspace(1e-3, np.pi - 1e-3, 13)
    return lathe(
        list(zip(radius * np.sin(angle), squash * radius * np.cos(angle), strict=True)), texture
    )


def smooth_normals(vertices: Float[Array, "V 3"], faces: Int[Array, "F 3"]) -> Float[Array, "V 3"]:
    """Area-weighted unit vertex normals."""
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = faces.ravel()
    weights = np.repeat(cross, 3, axis=0)
    normals = np.stack(
        [np.bincount(flat, weights[:, k], minlength=len(vertices)) for k in range(3)], -1
    )
    return normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
