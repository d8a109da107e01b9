"""Choreography of the person: feet stand or walk, the torso follows the object, hands by IK."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.spatial.transform import Rotation

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.body import BodyModel
from hoigs.core.values.moment import BodyPose
from hoigs.synthesis.config import SceneConfig
from hoigs.synthesis.kinematics import (
    about,
    forward_kinematics,
    frame_of,
    transposed,
    twist_about,
    two_bone,
    unit,
)
from hoigs.synthesis.object_motions import ObjectScript, bend_points, squeezed
from hoigs.synthesis.walking import SIDES, Walk

Array = np.ndarray
RELEASED = 0.12  # distance of a waiting hand from the surface, metres
X, Y, Z = np.eye(3)
HIPS, KNEES, ANKLES = (1, 2), (4, 5), (7, 8)
SPINE, NECK, HEAD, COLLARS = (3, 6, 9), 12, 15, (13, 14)
SHOULDERS, ELBOWS, WRISTS, MIDDLES = (16, 17), (18, 19), (20, 21), (25, 40)
COMFORT = 0.955  # largest distance of a hand, as a share of the arm's length


@dataclass(frozen=True)
class Palm:
    """The contact of a hand in the zero pose: offset from the wrist, and the frame
    [fingers, palm normal, cross product] as columns."""

    offset: Float[Array, "3"]
    frame: Float[Array, "3 3"]


@dataclass(frozen=True)
class HandTargets:
    """Targets of both palms: contact point and [fingers, palm normal, …] frame, by side."""

    points: tuple[Float[Array, "F 3"], Float[Array, "F 3"]]
    frames: tuple[Float[Array, "F 3 3"], Float[Array, "F 3 3"]]


def betas_of(body: BodyModel, config: SceneConfig) -> torch.Tensor:
    """The shape coefficients of the config, zero-padded to the body's number."""
    if len(config.betas) > body.num_betas:
        raise HoigsError(
            f"betas has {len(config.betas)} coefficients, but this body has {body.num_betas}; "
            "set at most that many"
        )
    betas = torch.zeros(body.num_betas)
    betas[: len(config.betas)] = torch.tensor(config.betas)
    return betas


def palms(body: BodyModel, betas: torch.Tensor) -> tuple[Palm, Palm]:
    """Contact points of both palms, found on the zero-pose mesh (fingers along x, palm down)."""
    vertices, joints = (x.detach().double().numpy() for x in body.shaped(betas))
    parts = body.vertex_parts.numpy()
    found = []
    for part, wrist, middle in zip((8, 9), WRISTS, MIDDLES, strict=True):
        knuckle = joints[middle if len(joints) == 52 else middle + 3]
        centre = joints[wrist] + 0.85 * (knuckle - joints[wrist])
        hand = vertices[parts == part]
        near = hand[np.linalg.norm((hand - centre)[:, [0, 2]], axis=1) < 0.02]
        if len(near) == 0:
            raise HoigsError(
                "no hand vertex lies near the palm's middle in the zero pose: the body's "
                "vertex_parts or joints do not follow BodyModel's convention (T-pose, y up)"
            )
        contact = np.array([centre[0], near[:, 1].min(), centre[2]])
        fingers = unit((knuckle - joints[wrist]) * [1, 0, 1])
        found.append(Palm(contact - joints[wrist], frame_of(fingers, -Y)))
    return found[0], found[1]


def hand_targets(script: ObjectScript, size: tuple[float, float, float]) -> HandTargets:
    """Palms on the object's two ends along x, fingers forward and down; off them by grip."""
    fingers = unit(np.array([0.0, -0.55, 0.83]))
    hold = script.hold
    points, frames = [], []
    for side in SIDES:
        local = np.array([side * size[0] / 2, 0.0, -0.1 * size[2]])
        pairs = [
            bend_points(squeezed(local, squeeze), bend, script.bend_width)
            for squeeze, bend in zip(script.squeeze, script.bend, strict=True)
        ]
        contact = np.stack([p for p, _ in pairs])
        turn = hold.rotations @ np.stack([r for _, r in pairs])
        outward = turn @ (side * X)
        away = (1 - script.grip)[:, None]
        free = away * (RELEASED * outward + 0.3 * RELEASED * Y - 0.35 * RELEASED * turn[..., 2])
        place = hold.translations + np.einsum("fij,fj->fi", hold.rotations, contact)
        points.append(place + free)
        frames.append(frame_of(turn @ fingers, -outward))
    return HandTargets((points[0], points[1]), (frames[0], frames[1]))


class Choreographer:
    """Poses a body over a clip so that its hands follow an object's script."""

    def __init__(self, body: BodyModel, config: SceneConfig):
        self.config, self.betas = config, betas_of(body, config)
        vertices, joints = (x.detach().double().numpy() for x in body.shaped(self.betas))
        count = len(body.parents) - 30  # 22, or 25 with jaw and eyes, come before the hands
        keep = [*range(22), *range(count, len(body.parents))]
        renumber = {old: new for new, old in enumerate(keep)}
        self.rest = joints[keep]
        self.parents = [renumber.get(body.parents[old], 15) if old else -1 for old in keep]
        self.sole = float(vertices[:, 1].min())
        self.palms = palms(body, self.betas)
        self.arm = [
            np.linalg.norm(self.rest[e] - self.rest[s])
            + np.linalg.norm(self.rest[w] - self.rest[e])
            for s, e, w in zip(SHOULDERS, ELBOWS, WRISTS, strict=True)
        ]

    def perform(self, script: ObjectScript) -> BodyPose:
        """Body poses for all frames.

        Raises:
            HoigsError: the hands cannot reach the object.
        """
        targets = hand_targets(script, self.config.object.size)
        wrists = [
            p - np.einsum("fij,j->fi", self._hand_rotation(k, f), self.palms[k].offset)
            for k, (p, f) in enumerate(zip(targets.points, targets.frames, strict=True))
        ]
        drop = self._stride_drop(script.walk)
        object_yaw, lean = self._lean(script, wrists, drop)
        local, root = self._torso(object_yaw, lean, drop)
        self._look(local, root, script.track.translations)
        self._legs(local, root, script.walk)
        missed = self._arms(local, root, wrists, targets)
        self._fingers(local, script.grip)
        if missed.max() > 0.01:
            frame = int(missed.argmax())
            raise HoigsError(
                f"at frame {frame} a hand stays {100 * missed.max():.1f} cm short of the object: "
                "the person cannot reach it; make object.size smaller, or bring "
                "object.stand_height and object.lift_height nearer to the chest"
            )
        local[:, 0] = script.walk.rotations @ local[:, 0]
        return self._pose(local, script.walk.to_world(root))

    def _stride_drop(self, walk: Walk) -> Array:
        """How far the pelvis drops so that the feet of a stride are in reach, metres."""
        leg = 0.5 * sum(
            float(np.linalg.norm(self.rest[b] - self.rest[a]))
            for a, b in (*zip(HIPS, KNEES, strict=True), *zip(KNEES, ANKLES, strict=True))
        )
        drop = leg - np.sqrt(leg**2 - np.minimum(walk.reach(), 0.7 * leg) ** 2)
        return gaussian_filter1d(drop, max(0.5, 0.012 * len(drop)), mode="nearest")

    def _hand_rotation(self, hand: int, frames: Array) -> Array:
        return frames @ self.palms[hand].frame.T

    def _lean(self, script: ObjectScript, wrists: list[Array], drop: Array) -> tuple[Array, Array]:
        """Yaw of the object, and the least forward lean from which both hands reach."""
        place = script.hold.translations
        yaw = np.arctan2(place[:, 0], place[:, 2])
        choices = np.radians(np.arange(2, 82, 2.0))
        short = np.stack(
            [self._shortfall(yaw, np.full(len(yaw), c), wrists, drop) for c in choices]
        )
        # where no lean suffices the best one is used, and `perform` measures the remaining distance
        least = np.where((short <= 0).any(0), (short <= 0).argmax(0), short.argmin(0))
        lean = choices[least]
        width = max(1, round(0.05 * len(yaw)))
        lean = maximum_filter1d(lean, 2 * width + 1, mode="nearest")
        return yaw, gaussian_filter1d(lean, max(0.5, 0.045 * len(yaw)), mode="nearest")

    def _shortfall(self, yaw: Array, lean: Array, wrists: list[Array], drop: Array) -> Array:
        """Metres by which the farther hand exceeds COMFORT."""
        local, root = self._torso(yaw, lean, drop)
        _, places = forward_kinematics(local, self.rest, self.parents, root)
        gaps = [
            np.linalg.norm(wrists[k] - places[:, SHOULDERS[k]], axis=-1) - COMFORT * self.arm[k]
            for k in range(2)
        ]
        return np.maximum(*gaps)

    def _torso(self, yaw: Array, lean: Array, stride_drop: Array) -> tuple[Array, Array]:
        """Pelvis, spine and collars that turn and lean towards the object."""
        count = len(yaw)
        local = np.broadcast_to(np.eye(3), (count, len(self.rest), 3, 3)).copy()
        hip_yaw, turn = 0.36 * yaw, 0.56 * yaw / 3
        local[:, 0] = about(Y, hip_yaw) @ about(X, 0.55 * lean)
        for joint, share in zip(SPINE, (0.18, 0.17, 0.10), strict=True):
            local[:, joint] = about(Y, turn) @ about(X, share * lean)
        for joint, side in zip(COLLARS, SIDES, strict=True):
            local[:, joint] = about(Y, np.full(count, -side * 0.16))
        drop = 0.035 + 0.21 * (1 - np.cos(np.minimum(lean, 1.2))) + stride_drop
        back = -0.16 * np.sin(lean)
        height = self.rest[0, 1] - self.sole - drop
        ahead = np.stack((np.sin(hip_yaw), np.zeros(count), np.cos(hip_yaw)), -1)
        root = height[:, None] * Y + back[:, None] * ahead
        root[:, 0] += 0.045 * np.sin(yaw)  # weight shifts to the leg on the object's side
        return local, root

    def _look(self, local: Array, root: Array, at: Array) -> None:
        """Neck and head share a turn of the gaze towards the object."""
        rotations, places = forward_kinematics(local, self.rest, self.parents, root)
        chest = rotations[:, SPINE[-1]]
        gaze = np.einsum("fji,fj->fi", chest, unit(at - places[:, HEAD]))
        yaw = np.clip(np.arctan2(gaze[:, 0], np.maximum(gaze[:, 2], 0.2)), -0.9, 0.9)
        level = np.hypot(gaze[:, 0], gaze[:, 2])
        pitch = np.clip(np.arctan2(-gaze[:, 1], level), -0.4, 0.75)
        for joint, share in ((NECK, 0.35), (HEAD, 0.45)):
            local[:, joint] = about(Y, share * yaw) @ about(X, share * pitch)

    def _legs(self, local: Array, root: Array, walk: Walk) -> None:
        """Place the feet as the walk does; knees bend forward over the toes."""
        rotations, places = forward_kinematics(local, self.rest, self.parents, root)
        for k, (hip, knee, ankle) in enumerate(zip(HIPS, KNEES, ANKLES, strict=True)):
            side, foot = SIDES[k], about(Y, walk.turns[k])
            spot = walk.spots[k] + (self.rest[ankle, 1] - self.sole) * Y
            pole = foot[:, :, 2] + 0.12 * side * X
            bones = (self.rest[knee] - self.rest[hip], self.rest[ankle] - self.rest[knee])
            thigh, shin, _ = two_bone(places[:, hip], spot, pole, bones, X)
            local[:, hip] = transposed(rotations[:, 0]) @ thigh
            local[:, knee] = transposed(thigh) @ shin
            local[:, ankle] = transposed(shin) @ foot

    def _arms(self, local: Array, root: Array, wrists: list[Array], targets: HandTargets) -> Array:
        """Elbows out and back, forearms twisted half-way to the hands. Returns metres missed."""
        rotations, places = forward_kinematics(local, self.rest, self.parents, root)
        missed = np.zeros(len(root))
        for k, side in enumerate(SIDES):
            shoulder, elbow, wrist = SHOULDERS[k], ELBOWS[k], WRISTS[k]
            chest = rotations[:, SPINE[-1]]
            pole = chest @ unit(np.array([0.75 * side, -0.55, -0.45]))
            bones = (self.rest[elbow] - self.rest[shoulder], self.rest[wrist] - self.rest[elbow])
            upper, fore, short = two_bone(places[:, shoulder], wrists[k], pole, bones, -side * Y)
            hand = self._hand_rotation(k, targets.frames[k])
            twist = twist_about(transposed(fore) @ hand, bones[1])
            fore = fore @ about(bones[1], 0.5 * twist)
            parent = rotations[:, COLLARS[k]]
            local[:, shoulder] = transposed(parent) @ upper
            local[:, elbow] = transposed(upper) @ fore
            local[:, wrist] = transposed(fore) @ hand
            missed = np.maximum(missed, short)
        return missed

    def _fingers(self, local: Array, grip: Array) -> None:
        """Slightly curled when free, flat on the object when holding; thumbs out of its way."""
        curl = 0.26 * (1 - grip)
        for first, side in ((22, 1.0), (37, -1.0)):
            bent = about(-side * Z, curl)
            for joint in range(first, first + 12):
                local[:, joint] = bent
            local[:, first + 12] = self._thumb_aside(first + 12)

    def _thumb_aside(self, thumb: int) -> Float[Array, "3 3"]:
        """Turn of a thumb's first joint that lifts it from the palm's side into its plane."""
        along = unit(self.rest[thumb + 2] - self.rest[thumb])
        level = unit(along * [1, 0, 1])
        lifted = unit(level + 0.15 * Y)
        axis = np.cross(along, lifted)
        angle = np.arctan2(np.linalg.norm(axis), along @ lifted)
        return about(axis, np.full(1, angle))[0]

    def _pose(self, local: Array, root: Array) -> BodyPose:
        """Matrices as a BodyPose, float32."""
        vectors = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec()
        pose = torch.from_numpy(vectors.reshape(*local.shape[:2], 3)).float()
        return BodyPose(
            global_orient=pose[:, 0],
            body=pose[:, 1:22],
            left_hand=pose[:, 22:37],
            right_hand=pose[:, 37:52],
            transl=torch.from_numpy(root - self.rest[0]).float(),
            betas=self.betas,
        )
