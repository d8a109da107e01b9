"""Cameras of a blurred video by SIFT's features and by learned ones, against a COLMAP model.

    hoigs estimators install xfeat
    hoigs prepare videos/backpack --out clips/backpack
    python benchmarks/learned_features.py clips/backpack videos/backpack/sparse --json OUT

Every frame of a prepared clip is blurred by a Gaussian of so many pixels, and structure from
motion is run on the frames outside the clip's masks: once with SIFT alone, once with learned
features alone. Cameras are compared after the best similarity (`sfm_against_supplied.py`).
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pycolmap
from PIL import Image
from scipy import ndimage
from sfm_against_supplied import similarity

from hoigs.preparation.cameras import learned_features, sfm
from hoigs.preparation.estimates.reader import GivenMasks
from hoigs.preparation.mask_stack import MaskStack
from hoigs.preparation.video.frames import open_frames
from hoigs.preparation.video.source import SourceError, frame_number


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("clip", type=Path, help="folder that `hoigs prepare` made")
    parser.add_argument("model", type=Path, help="folder of the COLMAP model to compare with")
    parser.add_argument("--blur", type=float, nargs="+", default=[0, 2, 3, 4], help="pixels, sigma")
    parser.add_argument("--json", type=Path, help="where the figures are written")
    args = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for sigma in args.blur:
            blurred = Path(folder) / f"{sigma:g}"
            masks = blur(args.clip, blurred, sigma)
            for learned in (False, True):
                work = Path(folder) / f"work-{sigma:g}-{learned}"
                row = {"blur_px": sigma, "features": "learned" if learned else "SIFT"}
                rows.append(row | cameras(blurred, masks, work, learned, args.model))
                print(rows[-1], flush=True)
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n")


def blur(clip: Path, target: Path, sigma: float) -> GivenMasks:
    """Writes the clip's frames, blurred, by their numbers in the video; its masks."""
    numbers = json.loads((clip / "clip.json").read_text())["provenance"]["frames"]
    target.mkdir()
    stack = MaskStack()
    files = sorted((clip / "images").iterdir())
    for number, file in zip(numbers, files, strict=True):
        image = np.asarray(Image.open(file).convert("RGB"), np.float32)
        soft = ndimage.gaussian_filter(image, (sigma, sigma, 0))
        Image.fromarray(soft.round().astype(np.uint8)).save(target / f"{number:05d}.png")
        found = [np.asarray(Image.open(m)) > 0 for m in (clip / "masks").glob(f"*/{file.stem}.*")]
        stack.append(np.any([m.reshape(*m.shape[:2], -1).any(-1) for m in found], axis=0))
    return GivenMasks(together=stack)


def cameras(
    frames: Path, masks: GivenMasks, work: Path, learned: bool, truth: Path
) -> dict[str, Any]:
    """Figures of one structure from motion."""
    begun = time.perf_counter()
    video = open_frames(frames)
    nothing = patch.object(sfm, "_match", lambda *_: None)  # SIFT finds no pair
    alone = patch.object(learned_features, "installed", lambda: None)
    try:
        with nothing if learned else alone:
            found = pycolmap.Reconstruction(sfm.structure_from_motion(video, masks, work))
    except SourceError:
        return {"cameras": 0, "seconds": round(time.perf_counter() - begun, 1)}
    ours, theirs = poses(found), poses(pycolmap.Reconstruction(str(truth)))
    common = sorted(set(ours) & set(theirs))
    one, two = (np.stack([m[i] for i in common]) for m in (ours, theirs))
    centers, target = (-np.einsum("fji,fj->fi", m[:, :, :3], m[:, :, 3]) for m in (one, two))
    scale, turn, shift = similarity(centers, target)
    off = np.linalg.norm(scale * centers @ turn.T + shift - target, axis=-1)
    between = np.einsum("fij,jk,flk->fil", one[:, :, :3], turn.T, two[:, :, :3])
    angle = np.degrees(np.arccos(np.clip((np.trace(between, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    return {
        "cameras": len(ours),
        "of": len(video),
        "centres_percent_of_path": round(
            100 * float(off.mean() / np.linalg.norm(np.diff(target, axis=0), axis=-1).sum()), 3
        ),
        "directions_degrees": round(float(angle.mean()), 3),
        "reprojection_px": round(found.compute_mean_reprojection_error(), 2),
        "seconds": round(time.perf_counter() - begun, 1),
    }


def poses(model: Any) -> dict[int, np.ndarray]:
    """World to camera [3, 4], by frame number."""
    return {
        frame_number(image.name): np.asarray(image.cam_from_world().matrix())
        for image in model.images.values()
        if image.has_pose
    }


if __name__ == "__main__":
    main()
