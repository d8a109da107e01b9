"""A toy model file in SMPL-X's layout: capsules around the bones of its joint tree, no licence."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

PARENTS = (
    -1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 15, 15, 15,
    20, 25, 26, 20, 28, 29, 20, 31, 32, 20, 34, 35, 20, 37, 38,
    21, 40, 41, 21, 43, 44, 21, 46, 47, 21, 49, 50, 21, 52, 53,
)  # fmt: skip
RING, RINGS = 5, 4  # vertices: 20 a bone


def rest_joints() -> np.ndarray:
    """[55, 3]: a T-pose with the pelvis off the origin, as SMPL-X has it."""
    joints = np.zeros((55, 3))
    joints[:25] = [
        (0.003, -0.35, 0.012), (0.06, -0.44, 0), (-0.06, -0.44, 0), (0, -0.24, -0.02),
        (0.11, -0.83, -0.01), (-0.11, -0.83, -0.01), (0, -0.1, -0.01), (0.1, -1.23, -0.05),
        (-0.1, -1.23, -0.05), (0, -0.05, 0), (0.12, -1.29, 0.07), (-0.12, -1.29, 0.07),
        (0, 0.11, -0.03), (0.05, 0.03, -0.01), (-0.05, 0.03, -0.01), (0.01, 0.28, 0),
        (0.17, 0.06, -0.02), (-0.17, 0.06, -0.02), (0.42, 0.01, -0.04), (-0.42, 0.01, -0.04),
        (0.67, 0.02, -0.05), (-0.67, 0.02, -0.05), (0, 0.26, 0.02), (0.03, 0.3, 0.06),
        (-0.03, 0.3, 0.06),
    ]  # fmt: skip
    for side, start in ((1, 25), (-1, 40)):
        for finger in range(5):
            for bone in range(3):
                reach = 0.78 + 0.03 * bone - 0.05 * (finger == 4)
                joints[start + 3 * finger + bone] = (side * reach, 0.02, 0.03 - 0.02 * finger)
    return joints


def toy_smplx(seed: int = 0, directions: int = 20) -> dict[str, np.ndarray]:
    """Arrays of a toy SMPL-X: 55 * 20 vertices; the regressor gives the ring means exactly."""
    rng = np.random.default_rng(seed)
    joints = rest_joints()
    vertices, faces, weights, regressor = [], [], [], np.zeros((55, 55 * RING * RINGS))
    for joint, parent in enumerate(PARENTS):
        start, end = joints[joint], joints[max(parent, 0)]
        axis = end - start + (0, 1e-3, 0)
        side = np.cross(axis, rng.normal(size=3))
        side /= np.linalg.norm(side)
        other = np.cross(axis / np.linalg.norm(axis), side)
        first = len(vertices)
        for ring in range(RINGS):
            along = ring / RINGS
            for k in range(RING):
                angle = 2 * np.pi * k / RING
                round_ = side * np.cos(angle) + other * np.sin(angle)
                vertices.append(start + along * axis + 0.02 * round_)
                row = np.zeros(55)
                row[joint] += 1 - along / 2
                row[max(parent, 0)] += along / 2
                weights.append(row)
        for ring in range(RINGS - 1):
            for k in range(RING):
                a, b = first + ring * RING + k, first + ring * RING + (k + 1) % RING
                faces += [(a, b, b + RING), (a, b + RING, a + RING)]
        regressor[joint, first : first + RING] = 1 / RING
    count = len(vertices)
    kintree = np.array([[2**32 - 1, *PARENTS[1:]], range(55)], dtype=np.uint32)
    return {
        "v_template": np.array(vertices),
        "f": np.array(faces, dtype=np.uint32),
        "weights": np.array(weights),
        "J_regressor": regressor,
        "posedirs": rng.normal(scale=1e-3, size=(count, 3, 486)),
        "shapedirs": rng.normal(scale=1e-2, size=(count, 3, directions)),
        "kintree_table": kintree,
        "hands_meanl": rng.normal(scale=0.2, size=45),
        "hands_meanr": rng.normal(scale=0.2, size=45),
    }


def write_toy(path: Path, **changes: np.ndarray) -> Path:
    np.savez(path, **{**toy_smplx(), **changes})
    return path


def by_formulas(
    file: dict[str, np.ndarray], betas: np.ndarray, angles: np.ndarray, parents: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and joints of a body at the origin, by the formulas of SMPL (lbs.py), one joint and
    one matrix at a time."""
    turns = Rotation.from_rotvec(angles).as_matrix()
    shaped = file["v_template"] + file["shapedirs"][:, :, : len(betas)] @ betas
    joints = file["J_regressor"] @ shaped
    bent = shaped + file["posedirs"] @ (turns[1:] - np.eye(3)).ravel()
    world: list[np.ndarray] = []
    for j, parent in enumerate(parents):
        local = np.eye(4)
        local[:3, :3] = turns[j]
        local[:3, 3] = joints[j] - (joints[parent] if j else 0)
        world.append(world[parent] @ local if j else local)
    back = np.tile(np.eye(4), (len(joints), 1, 1))
    back[:, :3, 3] = -joints
    skinning = np.einsum("vj,jab->vab", file["weights"], np.stack(world) @ back)
    vertices = np.einsum("vab,vb->va", skinning, np.c_[bent, np.ones(len(bent))])[:, :3]
    return vertices, np.stack(world)[:, :3, 3]
