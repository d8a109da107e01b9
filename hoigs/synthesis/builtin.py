"""The built-in clip: a SyntheticScene written as a clip folder, once, and cached."""

from __future__ import annotations

import functools
import hashlib
import os
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from hoigs.core.clip_folder.write import ClipWriter
from hoigs.core.interfaces.body import BodyModel
from hoigs.core.system.downloads import made
from hoigs.core.values.clip import POSES_EXACT, BodyTrack, ObjectTrack, uniform_test_split
from hoigs.core.values.world import World
from hoigs.synthesis.choreography import betas_of
from hoigs.synthesis.config import SceneConfig, name_of
from hoigs.synthesis.degradation import (
    damage,
    noisy_camera,
    noisy_depth,
    noisy_mask,
    noisy_poses,
    noisy_track,
    with_frames_dropped,
    with_shutter,
)
from hoigs.synthesis.generate import (
    ENTITIES,
    SyntheticScene,
    TrueView,
    canonical,
    generate,
    unproject,
)

PROVENANCE = "synthetic truth"
SOURCES_OF_POINTS = 8  # frames from which the initial scene points are back-projected

Progress = Callable[[int, int], None]


class GenerationNotice:
    """Says on stderr that a clip is generated, which takes minutes; in a terminal also how far."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __call__(self, done: int, frames: int) -> None:
        text = f"generating the clip {self._name}, once:"
        if sys.stderr.isatty():
            end = "\n" if done == frames else ""
            print(f"\r{text} frame {done} of {frames}", end=end, file=sys.stderr, flush=True)
        elif done == 0:
            print(f"{text} {frames} frames", file=sys.stderr, flush=True)


def cache_folder() -> Path:
    """$HOIGS_CACHE, or ~/.cache/hoigs."""
    named = os.environ.get("HOIGS_CACHE")
    return Path(named).expanduser() if named else Path.home() / ".cache" / "hoigs"


def builtin_clip(
    body: BodyModel,
    config: SceneConfig | None = None,
    *,
    body_key: str = "body:anny",
    progress: Progress | None = None,
) -> Path:
    """The clip folder of this config and body, generated unless it is cached.

    The cache key covers every setting, the body's shape and the generator's own source, so an old
    clip is never returned. The folder gets its name only when it is complete.

    Args:
        body: drawn and posed. body_key: its registry key, written into the clip.
        config: SceneConfig() by default.
        progress: called with (frames done, frames), before the first frame and after each, when a
            clip is generated; by default a notice on stderr.

    Returns:
        folder of a clip that `reader:clip` reads, with `truth.npz` in it (see `save_truth`).
    """
    config = config or SceneConfig()
    key = config.digest(generator_version(), body_digest(body, config), body_key)
    folder = cache_folder() / "clips" / f"builtin-{key}"
    if folder.exists():
        return folder
    progress = progress or GenerationNotice(name_of(config))
    progress(0, config.frames)
    scratch = Path(tempfile.mkdtemp(prefix=".builtin-", dir=made(folder.parent)))
    try:
        write_scene(generate(config, body), scratch / "clip", body_key=body_key, progress=progress)
        try:
            (scratch / "clip").rename(folder)
        except OSError:
            # another process has finished the same clip
            if not folder.exists():
                raise
    finally:
        shutil.rmtree(scratch)
    return folder


@functools.cache
def generator_version() -> str:
    """A hash of this package's source, so that a changed generator makes new clips."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def body_digest(body: BodyModel, config: SceneConfig) -> str:
    """A hash of the zero-pose mesh, joints and skinning weights."""
    digest = hashlib.sha256()
    with torch.no_grad():
        vertices, joints = body.shaped(betas_of(body, config))
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
    """Render every view and write a clip folder, with the noise of the config.

    Raises:
        ClipError: `folder` exists and is no clip.
    """
    scene = with_frames_dropped(scene)
    config = scene.config
    rng = np.random.default_rng(config.seed + 3)
    gather = _Points(scene, rng)
    with ClipWriter(
        folder,
        name=name_of(config),
        fps=config.fps,
        entities={"human": "human", "object": "object"},
        depth_kind="metric",
    ) as writer:
        for view, held_out in with_shutter(scene.views(), config.camera.shutter_frames):
            # held-out views are ground truth for evaluation, so they stay exact
            for other in held_out:
                masks = {name: other.mask(name) for name in ENTITIES}
                writer.add_held_out(other.frame, other.image, other.camera, masks, other.depth)
            masks = {name: noisy_mask(view.mask(name), config.noise, rng) for name in ENTITIES}
            depth = noisy_depth(view.depth, config.noise, rng)
            camera = noisy_camera(view.camera, config.noise, rng)
            writer.add_frame(view.image, camera, masks, depth)
            gather.add(view)
            if progress:
                progress(view.frame + 1, config.frames)
        poses = noisy_poses(scene.poses, config.noise, rng)
        writer.set_body("human", BodyTrack(body_key, poses, PROVENANCE))
        writer.set_object("object", gather.object_track())
        writer.set_points(*gather.scene_points())
        writer.set_split(uniform_test_split(config.frames, config.test_frames))
        writer.set_world(World(up=(0.0, 1.0, 0.0), floor=0.0))  # as room and walking have it
        writer.provenance.update(
            {
                "generator": f"hoigs.synthesis {generator_version()}",
                "config": config.model_dump(mode="json"),
                "truth": "truth.npz",
                POSES_EXACT: not config.noise.moves_poses(),
            }
        )
    save_truth(scene, folder / "truth.npz")
    damage(folder, config.noise, config.seed)


@torch.no_grad()
def save_truth(scene: SyntheticScene, path: Path) -> None:
    """Exact geometry, without the noise of the clip.

    Arrays: cameras as in cameras.npz; poses as in bodies/human.npz; `object_vertices` and
    `object_faces` about the object's centre, `object_rotations`, `object_translations`,
    `object_bend` (end-to-end angle, radians), `object_bend_width` (metres), `object_squeeze` (share
    of the width); `grip` (1 while the hands hold it);
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
        "object_bend_width": np.float64(scene.script.bend_width),
        "object_squeeze": scene.script.squeeze,
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
        config = scene.config
        sources = min(SOURCES_OF_POINTS, config.frames)
        self.sources = set(np.linspace(0, config.frames - 1, sources).round().astype(int).tolist())
        self.each = -(-config.scene_points // sources)
        self.each_object = -(-2 * config.object_points // config.frames)
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
        jitter = self.scene.config.noise.points_metres * self.rng.normal(size=points.shape)
        points = (points + jitter)[chosen]
        return torch.from_numpy(points).float(), torch.from_numpy(colors[chosen]).float()

    def scene_points(self) -> tuple[torch.Tensor, torch.Tensor]:
        return self._join(self.static, self.scene.config.scene_points)

    def object_track(self) -> ObjectTrack:
        config = self.scene.config
        points, colors = self._join(self.object, config.object_points)
        track = noisy_track(self.scene.script.track, config.noise, self.rng)
        seen = torch.tensor([len(p) > 0 for p, _ in self.object])
        return ObjectTrack(
            points=points,
            colors=colors,
            rotations=torch.from_numpy(track.rotations).float(),
            translations=torch.from_numpy(track.translations).float(),
            observed=seen,
            provenance=PROVENANCE,
        )
