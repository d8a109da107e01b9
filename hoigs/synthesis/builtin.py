"""The built-in clip: a SyntheticScene written as a clip folder, once, and cached."""

from __future__ import annotations

import functools
import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from hoigs.core.body import BodyModel
from hoigs.core.clip import BodyTrack, ObjectTrack, uniform_test_split
from hoigs.core.clip_folder import ClipWriter
from hoigs.synthesis.damage import damage, with_frames_dropped
from hoigs.synthesis.generate import (
    ENTITIES,
    SyntheticScene,
    TrueView,
    canonical,
    generate,
    unproject,
)
from hoigs.synthesis.knobs import SceneKnobs
from hoigs.synthesis.noise import noisy_camera, noisy_depth, noisy_mask, noisy_poses, noisy_track
from hoigs.synthesis.person import betas_of
from hoigs.synthesis.shutter import with_shutter

PROVENANCE = "synthetic truth"
SOURCES_OF_POINTS = 8  # frames from which the initial scene points are back-projected

Progress = Callable[[int, int], None]


def cache_folder() -> Path:
    """$HOIGS_CACHE, or ~/.cache/hoigs."""
    named = os.environ.get("HOIGS_CACHE")
    return Path(named).expanduser() if named else Path.home() / ".cache" / "hoigs"


def builtin_clip(
    body: BodyModel,
    knobs: SceneKnobs | None = None,
    *,
    body_key: str = "body:anny",
    progress: Progress | None = None,
) -> Path:
    """The clip folder for these knobs and this body, generated unless it is cached.

    The cache key covers every knob, the body's shape and the generator's own source, so a stale
    clip is never returned. The folder appears under its name only when it is whole.

    Args:
        body: drawn and posed. body_key: its registry key, written into the clip.
        knobs: SceneKnobs() by default.
        progress: called with (frames done, frames) after each frame, when one is generated.

    Returns:
        folder of a clip that `reader:clip` reads, with `truth.npz` in it (see `save_truth`).
    """
    knobs = knobs or SceneKnobs()
    key = knobs.digest(generator_version(), body_digest(body, knobs), body_key)
    folder = cache_folder() / "clips" / f"builtin-{key}"
    if folder.exists():
        return folder
    folder.parent.mkdir(parents=True, exist_ok=True)
    scratch = Path(tempfile.mkdtemp(prefix=".builtin-", dir=folder.parent))
    try:
        write_scene(generate(knobs, body), scratch / "clip", body_key=body_key, progress=progress)
        try:
            (scratch / "clip").rename(folder)
        except OSError:
            # another process finished the same clip first; its folder is as good as ours
            if not folder.exists():
                raise
    finally:
        shutil.rmtree(scratch)
    return folder


@functools.cache
def generator_version() -> str:
    """A hash of this package's source: any change of the generator makes new clips."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def body_digest(body: BodyModel, knobs: SceneKnobs) -> str:
    """A hash of the zero-pose mesh, joints and skinning weights."""
    digest = hashlib.sha256()
    with torch.no_grad():
        vertices, joints = body.shaped(betas_of(body, knobs))
    for values in (vertices, joints, body.faces, body.skinning_weights, body.vertex_parts):
        digest.update(np.ascontiguousarray(values.detach().cpu().numpy()).tobytes())
    return digest.hexdigest()[:16]


def write_scene(
    scene: SyntheticScene,
    folder: Path,
    *,
    body_key: str = "body:anny",
    progress: Progress | None = None,
) -> None:
    """Renders every view and writes a clip folder, with the noise that the knobs ask for.

    Raises:
        ClipError: `folder` exists and is no clip.
    """
    scene = with_frames_dropped(scene)
    knobs = scene.knobs
    rng = np.random.default_rng(knobs.seed + 3)
    gather = _Points(scene, rng)
    with ClipWriter(
        folder,
        name=f"builtin-{knobs.object.motion}",
        fps=knobs.fps,
        entities={"human": "human", "object": "object"},
        depth_kind="metric",
    ) as writer:
        for view, held_out in with_shutter(scene.views(), knobs.camera.shutter_frames):
            # held-out views judge, so they stay exact
            for other in held_out:
                masks = {name: other.mask(name) for name in ENTITIES}
                writer.add_held_out(other.frame, other.image, other.camera, masks, other.depth)
            masks = {name: noisy_mask(view.mask(name), knobs.noise, rng) for name in ENTITIES}
            depth = noisy_depth(view.depth, knobs.noise, rng)
            camera = noisy_camera(view.camera, knobs.noise, rng)
            writer.add_frame(view.image, camera, masks, depth)
            gather.add(view)
            if progress:
                progress(view.frame + 1, knobs.frames)
        poses = noisy_poses(scene.poses, knobs.noise, rng)
        writer.set_body("human", BodyTrack(body_key, poses, PROVENANCE))
        writer.set_object("object", gather.object_track())
        writer.set_points(*gather.scene_points())
        writer.set_split(uniform_test_split(knobs.frames, knobs.test_frames))
        writer.provenance.update(
            {
                "generator": f"hoigs.synthesis {generator_version()}",
                "knobs": knobs.model_dump(mode="json"),
                "truth": "truth.npz",
            }
        )
    save_truth(scene, folder / "truth.npz")
    damage(folder, knobs.noise, knobs.seed)


@torch.no_grad()
def save_truth(scene: SyntheticScene, path: Path) -> None:
    """Exact geometry, free of the noise that the clip may carry.

    Arrays: cameras as in cameras.npz; poses as in bodies/human.npz; `object_vertices` and
    `object_faces` about the object's centre, `object_rotations`, `object_translations`,
    `object_bend` (end-to-end angle, radians); `grip` (1 while the hands hold it);
    `dressed_vertices` and `dressed_faces`: the clothed body in the zero pose, to be skinned with
    `skinning_weights` and, a frame, `skinning_transforms`.
    """
    poses, track = scene.poses, scene.script.track
    arrays = {
        "K": np.stack([c.K.numpy() for c in scene.cameras]),
        "world_to_camera": np.stack([c.world_to_camera.numpy() for c in scene.cameras]),
        "global_orient": poses.global_orient.numpy(),
        "body": poses.body.numpy(),
        "left_hand": poses.left_hand.numpy(),
        "right_hand": poses.right_hand.numpy(),
        "transl": poses.transl.numpy(),
        "betas": poses.betas.numpy(),
        "object_vertices": scene.object_mesh.vertices,
        "object_faces": scene.object_mesh.faces,
        "object_rotations": track.rotations,
        "object_translations": track.translations,
        "object_bend": scene.script.bend,
        "grip": scene.script.grip,
        "dressed_vertices": scene.dressed.vertices.astype(np.float32),
        "dressed_faces": scene.dressed.faces,
        "skinning_weights": scene.dressed.weights,
        "skinning_transforms": scene.dressed.body.skinning_transforms(poses).numpy(),
    }
    np.savez_compressed(path, **arrays)  # type: ignore[arg-type]


class _Points:
    """Initial points, back-projected from depth as a real pipeline would."""

    def __init__(self, scene: SyntheticScene, rng: np.random.Generator) -> None:
        self.scene, self.rng = scene, rng
        knobs = scene.knobs
        sources = min(SOURCES_OF_POINTS, knobs.frames)
        self.sources = set(np.linspace(0, knobs.frames - 1, sources).round().astype(int).tolist())
        self.each = -(-knobs.scene_points // sources)
        self.each_object = -(-2 * knobs.object_points // knobs.frames)
        self.static: list[tuple[np.ndarray, np.ndarray]] = []
        self.object: list[tuple[np.ndarray, np.ndarray]] = []

    def add(self, view: TrueView) -> None:
        if view.frame in self.sources:
            self.static.append(self._sample(view, (view.entity == 0) & (view.depth > 0), self.each))
        points, colors = self._sample(view, view.mask("object"), self.each_object)
        self.object.append((canonical(self.scene, points, view.frame), colors))

    def _sample(
        self, view: TrueView, where: np.ndarray, count: int
    ) -> tuple[np.ndarray, np.ndarray]:
        rows = np.flatnonzero(where)
        chosen = self.rng.choice(rows, min(count, len(rows)), replace=False)
        mask = np.zeros(where.size, bool)
        mask[chosen] = True
        return unproject(view, mask.reshape(where.shape))

    def _join(
        self, parts: list[tuple[np.ndarray, np.ndarray]], count: int
    ) -> tuple[torch.Tensor, torch.Tensor]:
        points, colors = (np.concatenate(x) for x in zip(*parts, strict=True))
        chosen = np.sort(self.rng.permutation(len(points))[:count])
        jitter = self.scene.knobs.noise.points_metres * self.rng.normal(size=points.shape)
        points = (points + jitter)[chosen]
        return torch.from_numpy(points).float(), torch.from_numpy(colors[chosen]).float()

    def scene_points(self) -> tuple[torch.Tensor, torch.Tensor]:
        return self._join(self.static, self.scene.knobs.scene_points)

    def object_track(self) -> ObjectTrack:
        knobs = self.scene.knobs
        points, colors = self._join(self.object, knobs.object_points)
        track = noisy_track(self.scene.script.track, knobs.noise, self.rng)
        seen = torch.tensor([len(p) > 0 for p, _ in self.object])
        return ObjectTrack(
            points=points,
            colors=colors,
            rotations=torch.from_numpy(track.rotations).float(),
            translations=torch.from_numpy(track.translations).float(),
            observed=seen,
            provenance=PROVENANCE,
        )
