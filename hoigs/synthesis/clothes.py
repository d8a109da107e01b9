"""Clothes, shoes and a cap put on any BodyModel by rules about its zero pose.

Rules use joints, parts and distances, never vertex numbers, so every body that follows the
SMPL-X tree can be dressed. Cloth is the skin pushed out along its normals, painted by a function
of the zero-pose position.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from scipy.spatial import ConvexHull

from hoigs.core.interfaces.body import BodyModel
from hoigs.core.values.moment import BodyPose
from hoigs.synthesis.meshes import smooth_normals
from hoigs.synthesis.raycast import fine_barycentrics
from hoigs.synthesis.textures import hex_color, to_linear

Array = np.ndarray
SKIN, SHIRT, TROUSERS, SHOES, CAP, HAIR = range(6)
HEAD_PART, FOOT_PARTS = 3, (14, 15)
LEG_PARTS = (0, 10, 11, 12, 13, 14, 15)


@dataclass(frozen=True)
class Landmarks:
    """Heights and places of the zero pose that hems and rims refer to, metres."""

    sole: float
    ankle: float
    toe: float  # z
    heel: float  # z, a little before the end
    hip: float
    neck: float
    shoulder: float  # |x|
    elbow: float  # |x|
    chin: float
    crown: float
    brow: float
    face: float  # z of the forehead
    ear: float  # z of the ears

    @staticmethod
    def of(vertices: Array, joints: Array, parts: Array) -> Landmarks:
        head = vertices[parts == HEAD_PART]
        feet = vertices[np.isin(parts, FOOT_PARTS)]
        crown, base = float(head[:, 1].max()), float(joints[15, 1])
        above = head[head[:, 1] > base]
        return Landmarks(
            sole=float(vertices[:, 1].min()),
            ankle=float(joints[7, 1]),
            toe=float(feet[:, 2].max()),
            heel=float(feet[:, 2].min()) + 0.03,
            hip=float(joints[0, 1]),
            neck=float(joints[12, 1]),
            shoulder=float(abs(joints[16, 0])),
            elbow=float(abs(joints[18, 0])),
            chin=base - 0.02,
            crown=crown,
            brow=base + 0.50 * (crown - base),
            face=float(np.quantile(above[:, 2], 0.97)),
            ear=0.5 * float(above[:, 2].min() + above[:, 2].max()),
        )


@dataclass(frozen=True)
class DressedBody:
    """A dressed mesh in the zero pose, ready to be skinned.

    Attributes:
        vertices: of the outer surface. colors: linear RGB at each face's mesh-colour samples.
        weights: skinning weights of the body.
    """

    body: BodyModel
    vertices: Float[Array, "V 3"]
    faces: Int[Array, "F 3"]
    colors: Float[Array, "F N 3"]
    weights: Float[Array, "V J"]

    def posed(self, poses: BodyPose) -> Float[Array, "T V 3"]:
        """World positions at every frame of batched poses, metres."""
        with torch.no_grad():
            moves = self.body.skinning_transforms(poses).numpy().astype(np.float32)
        frames, joints = moves.shape[:2]
        ahead = np.concatenate((self.vertices, np.ones((len(self.vertices), 1))), 1)
        placed = np.empty((frames, len(self.vertices), 3), np.float32)
        for frame in range(frames):
            blended = self.weights @ moves[frame, :, :3].reshape(joints, 12)
            placed[frame] = np.einsum("vij,vj->vi", blended.reshape(-1, 3, 4), ahead)
        return placed


def dress(body: BodyModel, betas: torch.Tensor, thickness: float, seed: int) -> DressedBody:
    """Clothes on a body of a given shape.

    Args:
        thickness: how far cloth stands off the skin, metres; shoes and cap scale with it.
    """
    with torch.no_grad():
        vertices, joints = (x.double().numpy() for x in body.shaped(betas))
    faces = body.faces.numpy().astype(np.int64)
    parts = body.vertex_parts.numpy()
    marks = Landmarks.of(vertices, joints, parts)
    garment = garments(vertices, parts, marks)
    off = thickness * np.array([0.0, 1.0, 1.0, 1.1, 1.2, 0.5])[garment]
    neighbours = _adjacency(faces, len(vertices))
    shod = garment == SHOES
    outer = _forefoot_hulls(vertices, shod, marks)
    for _ in range(10):
        outer[shod] = (0.5 * outer + 0.5 * (neighbours @ outer))[shod]
    outer += off[:, None] * smooth_normals(outer, faces)
    outer[:, 1] = np.maximum(outer[:, 1], marks.sole)
    corners = vertices[faces]
    fine = np.einsum("nk,fkc->fnc", fine_barycentrics(), corners)
    fine_parts = np.broadcast_to(np.median(parts[faces], axis=1)[:, None], fine.shape[:2])
    colors = paint(fine.reshape(-1, 3), fine_parts.ravel().astype(int), marks, seed)
    return DressedBody(
        body,
        outer,
        faces,
        to_linear(colors).reshape(*fine.shape).astype(np.float32),
        body.skinning_weights.detach().numpy().astype(np.float32),
    )


def garments(points: Float[Array, "N 3"], parts: Int[Array, " N"], marks: Landmarks) -> Array:
    """What is worn at each zero-pose point: SKIN, SHIRT, TROUSERS, SHOES, CAP or HAIR."""
    x, y, z = np.abs(points[:, 0]), points[:, 1], points[:, 2]
    worn = np.full(len(points), SKIN)
    head = parts == HEAD_PART
    arm = marks.shoulder + 0.62 * (marks.elbow - marks.shoulder)
    collar = marks.neck + 0.005 - 0.35 * np.clip(z - 0.02, 0, 0.1)
    legs = np.isin(parts, LEG_PARTS)
    torso = ~head & ~legs & (x < arm) & (y < collar)
    hem = marks.hip - 0.015
    worn[torso | ((parts == 0) & (y > hem) & (x < arm))] = SHIRT
    worn[legs & (y <= hem) & (y > marks.ankle + 0.035)] = TROUSERS
    worn[legs & (y <= marks.ankle + 0.035)] = SHOES
    # a knitted cap down to the forehead and the ears; hair shows below it at the back
    rim = marks.brow + 0.046 - 0.42 * np.clip(marks.face - z, 0, 0.15)
    worn[head & (y > rim)] = CAP
    worn[head & (y <= rim) & (z < marks.ear - 0.022) & (y > marks.chin + 0.005)] = HAIR
    return worn


def paint(
    points: Float[Array, "N 3"], parts: Int[Array, " N"], marks: Landmarks, seed: int
) -> Float[Array, "N 3"]:
    """sRGB of zero-pose points in [0, 1]."""
    worn = garments(points, parts, marks)
    x, y, z = np.abs(points[:, 0]), points[:, 1], points[:, 2]
    color = np.empty_like(points)
    color[:] = hex_color("#d39a74")
    _paint_face(color, points, parts, marks)

    torso = marks.shoulder + 0.02
    navy, cream, coral = (np.array(hex_color(c)) for c in ("#27497a", "#f3ead7", "#d8553f"))
    along = np.where(x > torso, x + 0.013, y)
    shirt = _blend(navy, cream, _stripe(along, 0.062, 0.34))
    chest = _soft(0.032 - np.abs(y - (marks.neck - 0.20))) * (x < torso)
    collar = marks.neck - 0.012 - 0.35 * np.clip(z - 0.02, 0, 0.1)
    shirt = _blend(shirt, coral, np.maximum(chest, _soft(y - collar) * (x < 0.12)))

    drill = np.array(hex_color("#8f8061"))
    check = 0.13 * _stripe(y, 0.085, 0.14) + 0.13 * _stripe(points[:, 0], 0.070, 0.16)
    trousers = drill * (1.0 - check)[:, None]
    trousers = _blend(trousers, np.array(hex_color("#3b2a1e")), _soft(y - marks.hip + 0.045))

    ribs = np.arctan2(points[:, 0], z - marks.ear) * 16
    mustard = np.array(hex_color("#dba23a")) * (0.90 + 0.10 * np.sin(ribs))[:, None]
    rim = marks.brow + 0.046 - 0.42 * np.clip(marks.face - z, 0, 0.15)
    cap = _blend(mustard, np.array(hex_color("#8c3b2e")), _soft(rim + 0.034 - y))
    hair = np.broadcast_to(hex_color("#3a2417"), points.shape)
    shoe = _blend(np.array(hex_color("#9c2f2c")), cream, _soft(marks.heel - z))
    for kind, material in ((SHIRT, shirt), (TROUSERS, trousers), (SHOES, shoe), (CAP, cap),
                           (HAIR, hair)):  # fmt: skip
        color[worn == kind] = material[worn == kind]
    rng = np.random.default_rng(seed)
    mottle = 1 + 0.05 * _ripple(points, rng)
    return np.clip(color * mottle[:, None], 0, 1)


def _paint_face(color: Array, points: Array, parts: Array, marks: Landmarks) -> None:
    """Brows, eyes and a mouth, so that the head has a front."""
    x, y, z = np.abs(points[:, 0]), points[:, 1], points[:, 2]
    front = (parts == HEAD_PART) & (z > marks.face - 0.055)
    eye = marks.brow - 0.012
    spots = (
        (0.031, eye, 0.014, 0.0075, "#f5efe8"),
        (0.031, eye, 0.0065, 0.0070, "#2c1c14"),
        (0.032, eye + 0.019, 0.019, 0.0045, "#4a2f20"),
        (0.0, marks.chin + 0.26 * (marks.brow - marks.chin), 0.023, 0.0055, "#a8503f"),
    )
    for sx, sy, width, height, code in spots:
        inside = ((x - sx) / width) ** 2 + ((y - sy) / height) ** 2 < 1
        color[front & inside] = hex_color(code)


def _soft(signed: Float[Array, " N"], width: float = 0.005) -> Float[Array, " N"]:
    """0 to 1 over `width` metres about zero: edges that mesh colours can carry."""
    return np.clip(signed / width + 0.5, 0, 1)


def _stripe(position: Float[Array, " N"], period: float, share: float) -> Float[Array, " N"]:
    """1 within a stripe that takes a share of every period, soft-edged."""
    offset = np.abs((position / period) % 1 - 0.5) * period
    return _soft(share * period / 2 - offset)


def _blend(first: Array, second: Array, weight: Float[Array, " N"]) -> Array:
    return first * (1 - weight)[:, None] + second * weight[:, None]


def _ripple(points: Array, rng: np.random.Generator) -> Array:
    """A few random plane waves, in about [-1, 1]: slight unevenness of every material."""
    waves = rng.normal(0, 55, (3, 6))
    return np.sin(points @ waves + rng.uniform(0, 6.3, 6)).mean(-1) * 1.5


def _forefoot_hulls(vertices: Array, shod: Array, marks: Landmarks) -> Array:
    """Vertices with both forefeet grown to their convex hulls, where toes disappear."""
    outer = vertices.copy()
    front = shod & (vertices[:, 2] > marks.toe - 0.115)
    for side in (-1, 1):
        rows = np.flatnonzero(front & (side * vertices[:, 0] > 0))
        planes = ConvexHull(vertices[rows]).equations
        gaps = vertices[rows] @ planes[:, :3].T + planes[:, 3]
        nearest = gaps.argmax(1)
        depth = gaps[np.arange(len(rows)), nearest]
        outer[rows] -= depth[:, None] * planes[nearest, :3]
    return outer


def _adjacency(faces: Array, count: int) -> sparse.csr_matrix:
    """Row-normalised vertex adjacency."""
    i = faces[:, [0, 1, 2, 1, 2, 0]].ravel()
    j = faces[:, [1, 2, 0, 0, 1, 2]].ravel()
    links = sparse.csr_matrix((np.ones(len(i)), (i, j)), shape=(count, count))
    links.data[:] = 1.0
    return sparse.diags(1 / np.maximum(np.asarray(links.sum(1)).ravel(), 1)) @ links
