"""How well a prepared clip fits its inputs: the body's landmarks, and the ball's track.

    hoigs prepare videos/juggle --out clips/juggle
    python benchmarks/prepare_figures.py clips/juggle videos/juggle

Both are recomputed from the clip alone: its body is posed and projected by its cameras and compared
with the supplied landmarks that are visible (more than 0.5), its object's centre with the ball's.
Distances are in pixels of an image 1280 wide. Clips whose lens distortion was taken out are
compared with landmarks that still have it.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch

from hoigs.core.maths.skinning import skin
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.plugins.readers.clip import ClipFolderReader
from hoigs.preparation.body.landmarks import points_of

WIDTH = 1280


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("clip", type=Path, help="folder that `hoigs prepare` made")
    parser.add_argument("source", type=Path, help="folder that it was made from")
    parser.add_argument("--video-width", type=int, default=1280, help="of the source, pixels")
    args = parser.parse_args()
    clip = ClipFolderReader().read(args.clip)
    numbers = json.loads((args.clip / "clip.json").read_text())["provenance"]["frames"]
    unit = WIDTH / args.video_width  # pixels of the source to those of an image 1280 wide
    off = landmark_distances(clip, args.source / "pose_mediapipe.npz", numbers, unit)
    print(
        f"body overlay: {off.mean():.2f} px mean, {np.median(off):.2f} px median, "
        f"{np.quantile(off, 0.9):.2f} px at 90 %, {len(off)} visible landmarks"
    )
    if (args.source / "ball_track.npz").is_file():
        track = np.load(args.source / "ball_track.npz")["xyr"][numbers] * unit
        name = next(iter(clip.objects))
        centers = clip.objects[name].translations
        shown = [c.project(p)[0] for c, p in zip(clip.cameras, centers, strict=True)]
        scale = WIDTH / clip.cameras[0].width
        away = np.linalg.norm(torch.stack(shown).numpy() * scale - track[:, :2], axis=-1)
        away = away[np.isfinite(away)]
        print(f"ball centre: {away.mean():.2f} px mean, {away.max():.2f} px at most")


def landmark_distances(clip, path: Path, numbers: list[int], unit: float) -> np.ndarray:
    """Pixels between the body's points and the visible landmarks of all frames."""
    body, points = AnnyBody(), points_of(AnnyBody())
    rows = list(points.landmarks)
    given = np.load(path)["image_xyzv"][numbers][:, rows]
    vertices_of = points.vertices
    found = []
    name = next(iter(clip.bodies))
    scale = WIDTH / clip.cameras[0].width
    above = torch.tensor([body.parents[j] for j in points.joints.tolist()])
    carriers = torch.nn.functional.one_hot(above, len(body.parents)).float()
    carriers = torch.cat((carriers, body.skinning_weights[vertices_of]))
    poses = clip.bodies[name].poses
    vertices, joints = body.shaped(poses.betas)
    canonical = torch.cat((joints[points.joints], vertices[vertices_of]))
    world = skin(canonical, body.skinning_transforms(poses), carriers)
    for i, camera in enumerate(clip.cameras):
        xy, _ = camera.project(world[i])
        distance = np.linalg.norm(xy.numpy() * scale - given[i, :, :2] * unit, axis=-1)
        found.append(distance[given[i, :, 3] > 0.5])
    return np.concatenate(found)


if __name__ == "__main__":
    main()
