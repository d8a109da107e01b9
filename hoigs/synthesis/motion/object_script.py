"""ObjectScript: the scripted motion of the object, and the bending of its mesh."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from hoigs.synthesis.motion.ik import about
from hoigs.synthesis.motion.walking import Walk
from hoigs.synthesis.room.meshes import TexturedMesh
from hoigs.synthesis.room.room import Stand

Array = np.ndarray


@dataclass(frozen=True)
class Track:
    """A rigid path: object to world."""

    rotations: Float[Array, "F 3 3"]
    translations: Float[Array, "F 3"]


@dataclass(frozen=True)
class ObjectScript:
    """The motion of the object over a clip, and what the person does with it.

    Attributes:
        track: of the object. hold: the path that the hands follow (where the object is, or would
            be, while they hold it).
        grip: 1 where the hands touch, 0 where they are away, smooth between.
        bend: end-to-end angle, radians; 0 for a rigid object.
        stands: furniture that it stands on.
        walk: of the person. track and hold are in the person's frame until `in_world`.
    """

    track: Track
    hold: Track
    grip: Float[Array, " F"]
    bend: Float[Array, " F"]
    stands: tuple[Stand, ...]
    walk: Walk

    def in_world(self) -> ObjectScript:
        """The same script with track and hold in world space instead of the person's frame."""
        turn, walk = self.walk.rotations, self.walk
        return replace(
            self,
            track=Track(turn @ self.track.rotations, walk.to_world(self.track.translations)),
            hold=Track(turn @ self.hold.rotations, walk.to_world(self.hold.translations)),
        )


def bend_points(
    points: Float[Array, "*batch 3"], angle: float
) -> tuple[Float[Array, "*batch 3"], Float[Array, "*batch 3 3"]]:
    """Bends along x into an arc of unit stretch on the middle line.

    Args:
        angle: radians a metre of x (end-to-end angle over length).

    Returns:
        bent points, and the local rotation at each.
    """
    phase = points[..., 0] * angle
    rotation = about(np.array([0, 1, 0]), phase.ravel()).reshape(*phase.shape, 3, 3)
    x = points[..., 0] * np.sinc(phase / np.pi)
    z = points[..., 0] * np.sinc(phase / (2 * np.pi)) * np.sin(phase / 2) * -1.0
    middle = np.stack((x, np.zeros_like(x), z), -1)
    offset = points * np.array([0, 1.0, 1.0])
    return middle + np.einsum("...ij,...j->...i", rotation, offset), rotation


def bent_mesh(mesh: TexturedMesh, angle: float) -> TexturedMesh:
    """`mesh` after `bend_points`."""
    if angle == 0:
        return mesh
    vertices, rotations = bend_points(mesh.vertices, angle)
    turned = np.einsum("fcij,fcj->fci", rotations[mesh.faces], mesh.normals)
    return replace(mesh, vertices=vertices, normals=turned)
