"""Cameras of a prepared clip against a COLMAP model, after the best similarity between them.

    hoigs prepare videos/backpack --camera sfm --out clips/backpack
    python benchmarks/sfm_against_supplied.py clips/backpack videos/backpack/sparse

Prints the distance between camera centres as a part of the path's length, and the angle between
viewing directions. Images are matched by frame number.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import pycolmap

from hoigs.preparation.video.source import frame_number


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("clip", type=Path, help="folder that `hoigs prepare` made")
    parser.add_argument("model", type=Path, help="folder of the COLMAP model to compare with")
    args = parser.parse_args()
    numbers = json.loads((args.clip / "clip.json").read_text())["provenance"]["frames"]
    with np.load(args.clip / "cameras.npz") as arrays:
        ours = dict(zip(numbers, arrays["world_to_camera"].astype(np.float64), strict=True))
        focal = float(arrays["K"][0, 0, 0])
    model = pycolmap.Reconstruction(str(args.model))
    theirs = {
        frame_number(image.name): np.asarray(image.cam_from_world().matrix())
        for image in model.images.values()
        if image.has_pose
    }
    common = sorted(set(ours) & set(theirs))
    one, two = (np.stack([m[i] for i in common])[:, :3] for m in (ours, theirs))
    centers, target = (-np.einsum("fji,fj->fi", m[:, :, :3], m[:, :, 3]) for m in (one, two))
    scale, turn, shift = similarity(centers, target)
    off = np.linalg.norm(scale * centers @ turn.T + shift - target, axis=-1)
    path = np.linalg.norm(np.diff(target, axis=0), axis=-1).sum()
    between = np.einsum("fij,jk,flk->fil", one[:, :, :3], turn.T, two[:, :, :3])
    cosine = (np.trace(between, axis1=1, axis2=2) - 1) / 2
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    lens = next(iter(model.cameras.values()))
    print(f"images: {len(common)} common, {len(ours)} in the clip, {len(theirs)} in the model")
    print(
        f"camera centres: {100 * off.mean() / path:.3f} % of the path off on average, "
        f"{100 * off.max() / path:.3f} % at most"
    )
    print(f"directions: {angle.mean():.3f} degrees off on average, {angle.max():.3f} at most")
    print(f"focal length: {focal:.2f} px, the model's {lens.focal_length_x:.2f} px")


def similarity(source: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation and shift that take `source` nearest to `target` (Umeyama 1991)."""
    a, b = source - source.mean(0), target - target.mean(0)
    u, values, vt = np.linalg.svd(b.T @ a)
    sign = np.ones(3)
    sign[2] = np.sign(np.linalg.det(u @ vt))
    turn = u @ np.diag(sign) @ vt
    scale = float((values * sign).sum() / (a**2).sum())
    return scale, turn, target.mean(0) - scale * turn @ source.mean(0)


if __name__ == "__main__":
    main()
