"""Faults of whole files and frames: absent images and masks, NaN depth, lost frames.

Each has a random generator of its own, so that no setting changes the draws of another.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from hoigs.synthesis.config import NoiseConfig
from hoigs.synthesis.generate import SyntheticScene
from hoigs.synthesis.motion.object_script import Track


def damage(folder: Path, noise: NoiseConfig, seed: int) -> None:
    """Damage a written clip folder in place, except its held-out views and ground truth."""
    for share, pattern, stream in (
        (noise.mask_absent, "masks/*/*.png", 11),
        (noise.frames_absent, "images/*.png", 12),
    ):
        files = sorted(folder.glob(pattern))
        rng = np.random.default_rng([seed, stream])
        for row in rng.permutation(len(files))[: round(share * len(files))]:
            files[row].unlink()
    if noise.depth_nan == 0:
        return
    rng = np.random.default_rng([seed, 13])
    for path in sorted(folder.glob("depth/*.npz")):
        with np.load(path, allow_pickle=False) as archive:
            depth = archive["depth"].copy()
        depth[rng.uniform(size=depth.shape) < noise.depth_nan] = np.nan
        np.savez_compressed(path, depth=depth)


def with_frames_dropped(scene: SyntheticScene) -> SyntheticScene:
    """The scene with single frames lost, never the first, the last or two in a row.

    The clip does not record which. Held-out views of lost frames are lost too.
    """
    kept = frames_kept(scene.config.frames, scene.config.noise.frames_dropped, scene.config.seed)
    if len(kept) == scene.config.frames:
        return scene
    number = {old: new for new, old in enumerate(kept)}
    script = scene.script
    return replace(
        scene,
        config=scene.config.model_copy(update={"frames": len(kept)}),
        poses=scene.poses.map(lambda x: x[kept] if x.dim() > 1 else x),  # betas are shared
        script=replace(
            script,
            track=Track(script.track.rotations[kept], script.track.translations[kept]),
            hold=Track(script.hold.rotations[kept], script.hold.translations[kept]),
            grip=script.grip[kept],
            bend=script.bend[kept],
        ),
        cameras=[scene.cameras[i] for i in kept],
        held_out=[(number[f], camera) for f, camera in scene.held_out if f in number],
    )


def frames_kept(count: int, share: float, seed: int) -> list[int]:
    """The frames, of `count`, that are left when about `share` of them are lost."""
    lost: set[int] = set()
    for frame in np.random.default_rng([seed, 14]).permutation(np.arange(1, max(1, count - 1))):
        if len(lost) >= round(share * count):
            break
        if not lost & {frame - 1, frame + 1}:
            lost.add(int(frame))
    return [i for i in range(count) if i not in lost]
