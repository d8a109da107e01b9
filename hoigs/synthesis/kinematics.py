"""Forward and inverse kinematics of a joint tree whose rest frames are aligned with the world.

All arrays carry the frames as leading axis; rotations are matrices acting on columns.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Num

Array = np.ndarray


def unit(vectors: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """Vectors of length 1; zero stays zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def transposed(rotations: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3 3"]:
    """Inverse rotations."""
    return np.swapaxes(rotations, -1, -2)


def forward_kinematics(
    local: Float[Array, "F J 3 3"],
    rest: Float[Array, "J 3"],
    parents: Sequence[int],
    root: Float[Array, "F 3"],
) -> tuple[Float[Array, "F J 3 3"], Float[Array, "F J 3"]]:
    """World rotation and position of every joint; `root` is where joint 0 is, metres."""
    rotations, positions = np.empty_like(local), np.empty((*local.shape[:2], 3))
    for joint, parent in enumerate(parents):
        if parent < 0:
            rotations[:, joint], positions[:, joint] = local[:, joint], root
        else:
            rotations[:, joint] = rotations[:, parent] @ local[:, joint]
            offset = rest[joint] - rest[parent]
            positions[:, joint] = positions[:, parent] + rotations[:, parent] @ offset
    return rotations, positions


def frame_of(axis: Float[Array, "*batch 3"], hinge: Float[Array, "*batch 3"]) -> Array:
    """Orthonormal frame [axis, hinge made orthogonal to it, their cross product], as columns."""
    axis = unit(axis)
    hinge = unit(hinge - (hinge * axis).sum(-1, keepdims=True) * axis)
    return np.stack((axis, hinge, np.cross(axis, hinge)), -1)


def two_bone(
    start: Float[Array, "F 3"],
    target: Float[Array, "F 3"],
    pole: Float[Array, "F 3"],
    rest_bones: tuple[Float[Array, "3"], Float[Array, "3"]],
    rest_hinge: Float[Array, "3"],
    reach: float = 0.9985,
) -> tuple[Float[Array, "F 3 3"], Float[Array, "F 3 3"], Float[Array, " F"]]:
    """World rotations of two bones that take the tip to `target`, in closed form.

    The middle joint lies on the side of `pole`, and both bones turn about one hinge, so that a
    knee or an elbow bends as one does.

    Args:
        start: of the first bone. target: of the tip; beyond `reach` it is approached only.
        rest_bones: vectors of both bones in the rest pose.
        rest_hinge: in the rest pose, first bone x second bone for a small natural flexion.

    Returns:
        rotations of the first and the second bone, and how far the tip stays off, metres.
    """
    a, b = (float(np.linalg.norm(bone)) for bone in rest_bones)
    line = target - start
    distance = np.linalg.norm(line, axis=-1)
    used = np.clip(distance, abs(a - b) + 1e-6, reach * (a + b))
    along = line / np.maximum(distance, 1e-9)[:, None]
    cosine = np.clip((a * a + used**2 - b * b) / (2 * a * used), -1, 1)
    side = unit(pole - (pole * along).sum(-1, keepdims=True) * along)
    first = cosine[:, None] * along + np.sqrt(1 - cosine**2)[:, None] * side
    second = used[:, None] * along - a * first
    hinge = np.cross(side, along)
    rests = [frame_of(bone, rest_hinge) for bone in rest_bones]
    rotations = [
        frame_of(bone, hinge) @ rest.T for bone, rest in zip((first, second), rests, strict=True)
    ]
    return rotations[0], rotations[1], np.abs(distance - used)


def twist_about(rotation: Float[Array, "F 3 3"], axis: Float[Array, "3"]) -> Float[Array, " F"]:
    """Angle of the twist part (swing-twist decomposition) of rotations about an axis, radians."""
    w = 0.5 * np.sqrt(np.maximum(1 + np.trace(rotation, axis1=1, axis2=2), 1e-9))
    skew = np.stack(
        (
            rotation[:, 2, 1] - rotation[:, 1, 2],
            rotation[:, 0, 2] - rotation[:, 2, 0],
            rotation[:, 1, 0] - rotation[:, 0, 1],
        ),
        -1,
    )
    along = (skew / (4 * w[:, None])) @ unit(axis)
    return 2 * np.arctan2(along, w)


def about(axis: Num[Array, "3"], angle: Float[Array, " F"]) -> Float[Array, "F 3 3"]:
    """Rotations about one axis (Rodrigues), radians."""
    x, y, z = unit(np.asarray(axis, float))
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.asarray(angle, float)[:, None, None]
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)
