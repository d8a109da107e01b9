"""How far MediaPipe's landmarks are off, on renders of the built-in body.

    python benchmarks/landmark_errors.py --clips 40 --json benchmarks/results/landmark_errors.json

Clips of a rendered person of random shape, who moves from one random pose to the next before a
camera that stands still, from all sides, standing or seated, whole or cut off at the hips;
MediaPipe sees the pixels alone. Of each left-right pair of landmarks, millimetres on the body:

- `place`: where the landmark lies about the joint or vertex that stands for it, in the rest pose
  (x outwards, y up, z ahead), fitted to the pixels of all clips;
- `image`: what it is off from there in the image, a component, by the median;
- `depth`: bias and spread of its depth in space about the middle of the shoulders, along the axis
  of the network; and `as_given`, the spread if that is taken for the camera's axis.

The constants of the fit, `IN_IMAGE` and `IN_SPACE`, are round numbers from here.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from hoigs.core.interfaces.estimator import VideoRequest
from hoigs.core.values.camera import Camera
from hoigs.core.values.moment import BodyPose
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.plugins.estimators.mediapipe.estimator import MediapipeConfig, MediapipeEstimator
from hoigs.preparation.body.kinematics import Kinematics
from hoigs.preparation.body.landmarks import Landmarks, points_of
from hoigs.preparation.body.priors import beyond
from hoigs.synthesis.clothes import dress
from hoigs.synthesis.config import LightConfig
from hoigs.synthesis.meshes import TexturedMesh, smooth_normals
from hoigs.synthesis.raycast import Layer, RayCaster, fine_array
from hoigs.synthesis.room import HIGH, LOW, Palette, build_room
from hoigs.synthesis.textures import TextureAtlas, to_srgb

FRAMES, FPS = 24, 8.0
SIDE = 400  # pixels of the square frames
KEYS = 4  # poses that a clip passes through


@dataclass(frozen=True)
class Clip:
    """A person before a camera; metres, y up."""

    poses: BodyPose
    camera: Camera


def random_clip(body: AnnyBody, rng: np.random.Generator) -> Clip:
    """A shape, a way through a few poses, and a camera in the room."""
    legs = rng.choice(("standing", "seated"), p=(0.6, 0.4))
    stance = random_legs(legs, rng)
    keys = np.stack([random_pose(body, stance, rng) for _ in range(KEYS)])
    at = np.linspace(0, KEYS - 1, FRAMES)
    first = np.minimum(at.astype(int), KEYS - 2)
    part = at - first
    part = (part * part * (3 - 2 * part))[:, None, None]
    turns = keys[first] * (1 - part) + keys[first + 1] * part
    facing = rng.normal(0, 50) if rng.random() < 0.75 else rng.uniform(-180, 180)
    tilt = Rotation.from_euler("yxz", [facing, rng.normal(0, 5), rng.normal(0, 5)], degrees=True)
    betas = torch.from_numpy(rng.normal(0, 0.8, body.num_betas)).float()
    poses = BodyPose(
        torch.from_numpy(tilt.as_rotvec()).float().expand(FRAMES, 3).clone(),
        torch.from_numpy(turns).float(),
        torch.zeros(FRAMES, 15, 3), torch.zeros(FRAMES, 15, 3), torch.zeros(FRAMES, 3), betas,
    )  # fmt: skip
    with torch.no_grad():
        joints = body(poses.frame(0)).joints.numpy()
    floor = joints[:, 1].min() - 0.06
    poses = poses.replace(transl=torch.tensor([0.0, -floor, 0.0]).expand(FRAMES, 3).clone())
    joints[:, 1] -= floor
    cut = legs == "seated" or rng.random() < 0.25
    target = joints[12] * [1, 0.85, 1] if cut else joints[0]
    fov = np.radians(rng.uniform(35, 65))
    extent = rng.uniform(0.9, 1.6) if cut else rng.uniform(2.0, 4.0)
    distance = min(0.5 * extent / np.tan(fov / 2), 4.2)
    away = np.array([np.sin(b := rng.normal(0, 0.15)), 0, np.cos(b)])
    eye = target + distance * away + [0, rng.uniform(-0.25, 0.45) * min(distance, 2), 0]
    eye[1] = np.clip(eye[1], 0.3, HIGH[1] - 0.2)
    aside = rng.normal(0, 0.12, 3) * extent * [1, 0.6, 0]
    camera = Camera.look_at(
        torch.from_numpy(eye), torch.from_numpy(target + aside), width=SIDE, height=SIDE,
        fov_y=float(fov),
    )  # fmt: skip
    return Clip(poses, camera.to(torch.float32))


def random_legs(kind: str, rng: np.random.Generator) -> np.ndarray:
    """Axis-angle of hips, knees and ankles, [21, 3]."""
    pose = np.zeros((21, 3))
    for hip, knee, ankle, side in ((0, 3, 6, 1), (1, 4, 7, -1)):
        spread = abs(rng.normal(0.05, 0.08))
        if kind == "seated":
            lift, bend = rng.normal(-1.45, 0.12), rng.normal(1.45, 0.15)
        else:
            lift = rng.normal(-0.15, 0.2)
            bend = max(0.05, rng.normal(0.2, 0.2))
        pose[hip] = (lift, 0, side * spread)
        pose[knee, 0] = bend
        pose[ankle, 0] = np.clip(-lift - bend, -0.4, 0.4)
    return pose


def random_pose(body: AnnyBody, legs: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Axis-angle of the body's joints within their limits, hands out of the trunk, [21, 3]."""
    while True:
        pose = legs.copy()
        pose[[2, 5, 8]] = rng.normal(0, (0.08, 0.08, 0.05), (3, 3)) + np.array([0.03, 0, 0])
        pose[[11, 14]] = rng.normal(0, (0.12, 0.2, 0.08), (2, 3))
        for shoulder, elbow, wrist, side in ((15, 17, 19, 1), (16, 18, 20, -1)):
            height = rng.normal(-0.7, 0.5)  # radians above the horizon
            ahead = rng.uniform(-0.2, 1.7)  # from sideways to forwards
            level, up = np.cos(height), np.sin(height)
            to = np.array([side * level * np.cos(ahead), up, level * np.sin(ahead)])
            plain = np.cross([side, 0, 0], to)
            angle = np.arccos(np.clip(side * to[0], -1, 1))
            turn = Rotation.from_rotvec(plain / max(np.linalg.norm(plain), 1e-6) * angle)
            twist = Rotation.from_rotvec([side * rng.normal(0, 0.6), 0, 0])
            pose[shoulder] = (turn * twist).as_rotvec()
            pose[elbow, 1] = -side * np.clip(rng.normal(1.0, 0.6), 0.05, 2.3)
            pose[wrist] = rng.normal(0, 0.2, 3)
        one = torch.from_numpy(pose).float()
        if float(beyond(one).abs().max()) > 0.05:
            continue
        with torch.no_grad():
            rest = BodyPose.zeros(1, betas=body.num_betas).replace(body=one[None])
            joints = body(rest.frame(0)).joints.numpy()
        hands = joints[[20, 21]]
        inside = (np.abs(hands[:, 0]) < 0.2) & (hands[:, 2] < 0.16) & (hands[:, 2] > -0.3)
        if not (inside & (hands[:, 1] < joints[12, 1])).any():
            return pose


class Studio:
    """Renders clips in the living room of the built-in clips."""

    def __init__(self, body: AnnyBody, seed: int) -> None:
        self.body, self.seed = body, seed
        palette = Palette()
        room = build_room(palette, (), seed)
        light = LightConfig()
        shell = Layer.build(room.shell, np.zeros(len(room.shell.faces), int))
        self.caster = RayCaster(shell, TextureAtlas.pack(palette.images), light, (LOW, HIGH), 2, 4)
        self.props = room.props

    def frames(self, clip: Clip, seed: int) -> Iterator[np.ndarray]:
        """RGB images, in order."""
        dressed = dress(self.body, clip.poses.betas, 0.01, seed)
        fine, places = fine_array(dressed.colors), dressed.posed(clip.poses)

        def render(i: int) -> np.ndarray:
            faces = dressed.faces
            person = TexturedMesh(
                places[i], faces, smooth_normals(places[i], faces)[faces],
                np.zeros((len(faces), 3, 2)), np.full(len(faces), -1),
            )  # fmt: skip
            numbers = np.repeat([1, 0], [len(faces), len(self.props.faces)])
            layer = Layer.build(TexturedMesh.join([person, self.props]), numbers, fine)
            color = self.caster.render(clip.camera, layer).color
            return np.round(255 * to_srgb(color)).clip(0, 255).astype(np.uint8)

        with ThreadPoolExecutor(2) as pool:
            yield from pool.map(render, range(len(places)))


def seen(images: list[np.ndarray], work: Path) -> tuple[np.ndarray, np.ndarray]:
    """MediaPipe's landmarks in the image and in space, [F, 33, 4] each."""
    height, width = images[0].shape[:2]
    request = VideoRequest(
        len(images), width, height, lambda i: images[i], work, work, static_camera=True, fps=FPS
    )
    estimator = MediapipeEstimator(MediapipeConfig(masks=False))
    marks = estimator.estimate(request).landmarks["human"]
    return marks.image_xyzv, marks.world_xyzv


def observed(body: AnnyBody, count: int, seed: int, pictures: Path | None) -> list[dict[str, Any]]:
    """Of each clip its camera, poses and landmarks."""
    studio, found = Studio(body, seed), []
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        clip = random_clip(body, rng)
        images = list(studio.frames(clip, number))
        if pictures is not None:
            from PIL import Image

            Image.fromarray(np.concatenate(images[::8], 1)).save(pictures / f"{number:03d}.png")
        with tempfile.TemporaryDirectory() as work:
            image, world = seen(images, Path(work))
        found.append({"clip": clip, "image": image, "world": world})
        print(f"clip {number + 1} of {count}", flush=True)
    return found


STEPS, OUTLIER, VISIBLE, LEAST = 12, 0.03, 0.7, 100
NAMES = {
    0: "nose", 7: "ear", 11: "shoulder", 13: "elbow", 15: "wrist", 17: "little finger",
    19: "index finger", 23: "hip", 25: "knee", 27: "ankle", 29: "heel", 31: "toe",
}  # fmt: skip


class Measured:
    """Landmarks of clips against the body's own points."""

    def __init__(self, body: AnnyBody, clips: list[dict[str, Any]]) -> None:
        self.points, self.clips = points_of(body), clips
        self.kinematics = Kinematics(body, self.points.joints, self.points.vertices)
        self.marks = list(self.points.landmarks)
        self.pairs = sorted({m if m % 2 or m == 0 else m - 1 for m in self.marks})
        self.places = torch.zeros(len(self.pairs), 3, dtype=torch.float64)

    def true(self, clip: Clip) -> tuple[Any, torch.Tensor]:
        """The points with their derivatives, and along the camera's axes."""
        at = self.kinematics.posed(clip.poses, self.places[self.points.pairs] * self.points.mirror)
        view = clip.camera.world_to_camera.double()
        return at, at.points @ view[:3, :3].mT + view[:3, 3]

    def off(self, found: dict[str, Any], cam: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Metres between points and landmarks across the image, NaN where these are not seen."""
        K = found["clip"].camera.K.double()
        image = torch.from_numpy(found["image"][:, self.marks]).double()
        inside = ((image[..., :2] > 0) & (image[..., :2] < SIDE)).all(-1)
        seen = inside & (image[..., 3] > VISIBLE)
        metres = cam[..., 2:] / K[0, 0]
        pixels = cam[..., :2] / metres + K[:2, 2]
        return (pixels - image[..., :2]) * metres, seen

    def fit_places(self) -> None:
        """Gauss-Newton with the weights of Geman and McClure."""
        for step in range(STEPS):
            spread = (OUTLIER * max(1, 4 - step)) ** 2
            matrix = 1e-6 * torch.eye(3, dtype=torch.float64).repeat(len(self.pairs), 1, 1)
            gradient = torch.zeros_like(self.places)
            for found in self.clips:
                at, cam = self.true(found["clip"])
                miss, seen = self.off(found, cam)
                turned = found["clip"].camera.world_to_camera[:3, :3].double() @ at.by_rest
                ray = (cam[..., :2] / cam[..., 2:])[..., None]
                across = (turned[..., :2, :] - ray * turned[..., 2:, :]) * self.points.mirror[
                    :, None
                ]
                miss = miss.nan_to_num()
                weight = seen * (spread / (spread + miss.square().sum(-1))).square()
                matrix.index_add_(
                    0, self.points.pairs,
                    torch.einsum("flic,flid,fl->lcd", across, across, weight),
                )  # fmt: skip
                gradient.index_add_(
                    0, self.points.pairs, torch.einsum("flic,fli,fl->lc", across, miss, weight)
                )
            self.places -= torch.linalg.solve(matrix, gradient[..., None])[..., 0]

    def rows(self) -> dict[str, Any]:
        """Of each pair, what the module's text says."""
        image: list[list[np.ndarray]] = [[] for _ in self.pairs]
        depth: list[list[np.ndarray]] = [[] for _ in self.pairs]
        given: list[list[np.ndarray]] = [[] for _ in self.pairs]
        middle = [self.marks.index(11), self.marks.index(12)]
        for found in self.clips:
            _, cam = self.true(found["clip"])
            miss, seen = self.off(found, cam)
            marks = Landmarks(
                torch.from_numpy(found["image"][..., [0, 1, 3]]).double(),
                torch.from_numpy(found["world"][..., :3]).double(), to_hips=True,
            )  # fmt: skip
            K = found["clip"].camera.K.double().expand(len(cam), 3, 3)
            for space, into in ((marks.in_cameras(K).world, depth), (marks.world, given)):
                error = space[:, self.marks, 2] - cam[..., 2]
                error = error - error[:, middle].mean(1, keepdim=True)
                for row, pair in enumerate(self.points.pairs.tolist()):
                    into[pair].append(error[:, row][seen[:, row]].numpy())
            for row, pair in enumerate(self.points.pairs.tolist()):
                image[pair].append(miss[:, row][seen[:, row]].square().sum(-1).numpy())
        result = {}
        for k, mark in enumerate(self.pairs):
            squares, z, raw = (np.concatenate(values[k]) for values in (image, depth, given))
            if len(squares) < LEAST:
                continue
            result[NAMES[mark]] = {
                "seen": len(squares),
                "place": (1000 * self.places[k]).round().int().tolist(),
                "image": round(1000 * float(np.sqrt(np.median(squares) / 1.386)), 1),
                "depth": [round(1000 * float(v)) for v in (z.mean(), z.std())],
                "as_given": round(1000 * float(raw.std())),
            }
        return result


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clips", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--pictures", type=Path, help="folder for a strip of frames of each clip")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    body = AnnyBody()
    measured = Measured(body, observed(body, args.clips, args.seed, args.pictures))
    with torch.no_grad():
        measured.fit_places()
    rows = measured.rows()
    for name, row in rows.items():
        print(name, json.dumps(row))
    if args.json:
        args.json.write_text(json.dumps({"clips": args.clips, "pairs": rows}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
