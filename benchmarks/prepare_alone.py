"""What `hoigs prepare VIDEO` finds by itself, against what was supplied with a recorded clip.

    python benchmarks/prepare_alone.py juggle backpack --json benchmarks/results/prepare-alone.json

Each video is copied alone into an empty folder and prepared with `--estimators offline` and nothing
else given. Compared are:

- the person's mask with the supplied one of person and object, both without the tracked ball where
  there is one: intersection over union, its mean and that of the worst 5 % of frames. The supplied
  masks are MediaPipe's selfie segmentation, one of the three that the mask here is the mean of:
  agreement shows that nothing went wrong, and not that the mask is right.
- landmarks, in pixels of the video, median over all that are visible (more than 0.5) in both. The
  supplied ones are of complexity 1, so `--complexity 1` tests the pipe, and 2 (the default) shows
  how far the two models are from each other.
- seconds of each stage, which an idle machine has to be asked for, and seconds of all processors,
  which depend less on what else runs.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from hoigs.core.npz import load_arrays
from hoigs.preparation.estimates import RawEstimates
from hoigs.preparation.options import PrepareOptions
from hoigs.preparation.prepare import prepare, prepare_until, work_folder
from hoigs.preparation.saved import from_result
from hoigs.preparation.stages.work_folder import ARRAYS, RESULT, Result

SHARED = Path(os.environ.get("HOIGS_SHARED", Path(__file__).resolve().parents[2] / "shared"))
VISIBLE = 0.5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("clips", nargs="+", help="folders of recorded clips")
    parser.add_argument("--complexity", type=int, default=2, help="of MediaPipe's model")
    parser.add_argument("--object", action="append", default=[], help="as of `hoigs prepare`")
    parser.add_argument("--until", help="stop after this stage; default: the whole clip")
    parser.add_argument("--json", type=Path, help="add the results to this file")
    parser.add_argument("--keep", type=Path, help="folder in which the prepared clips stay")
    args = parser.parse_args()
    found = json.loads(args.json.read_text()) if args.json and args.json.is_file() else {}
    for name in args.clips:
        with tempfile.TemporaryDirectory() as temporary:
            keep = args.keep or Path(temporary)
            row = measure(SHARED / "data" / name, keep, args)
        print(name, json.dumps(row, indent=1))
        found[f"{name}, complexity {args.complexity}"] = row
        if args.json:
            args.json.write_text(json.dumps(found, indent=1) + "\n")


def measure(source: Path, keep: Path, args: argparse.Namespace) -> dict[str, Any]:
    """One clip's figures."""
    alone = keep / f"{source.name}-alone"
    alone.mkdir(parents=True, exist_ok=True)
    video = Path(shutil.copy(source / "video.mp4", alone))
    use = {"use": "estimator:mediapipe", "complexity": args.complexity}
    options = PrepareOptions.model_validate(
        {"estimators": {"landmarks": use, "masks": use}, "overwrite": True}
    )
    out, start, before = keep / source.name, time.perf_counter(), processor_seconds()
    common: dict[str, Any] = {"object": args.object, "options": options, "yes": True}
    if args.until:
        seconds = prepare_until(args.until, video, out, **common)
    else:
        seconds = prepare(video, out, **common).seconds
    raw = evidence(work_folder(out))
    return {
        "seconds": round(time.perf_counter() - start, 1),
        "stages": {stage: round(value, 1) for stage, value in seconds.items()},
        "processor_seconds": round(processor_seconds() - before, 1),
        "cores": os.cpu_count(),
        "load": round(os.getloadavg()[1], 1),
        "machine": platform.machine(),
        "object": args.object or "no prompt",
        **masks_against(raw, source),
        **landmarks_against(raw, source),
    }


def processor_seconds() -> float:
    """Of this process and of the tools that it has run so far."""
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system


def evidence(work: Path) -> RawEstimates:
    """What the estimators of the person found."""
    folder = work / "evidence"
    content = json.loads((folder / RESULT).read_text())
    found: RawEstimates = from_result(
        Result(content["values"]["made"], load_arrays(folder / ARRAYS))
    )
    return found


def masks_against(raw: RawEstimates, source: Path) -> dict[str, Any]:
    """Intersection over union of the person's masks."""
    human, supplied = raw.masks.human, source / "hoi_mask"
    if human is None or not supplied.is_dir():
        return {"person_iou": f"not computed: no masks are supplied with {source.name}"}
    track = source / "ball_track.npz"
    balls = np.load(track)["xyr"] if track.is_file() else None
    scores = []
    for i, mask in enumerate(human):
        with Image.open(supplied / f"{i:05d}.png") as image:
            true = np.asarray(image.convert("L")) > 127
        valid = np.ones_like(true)
        if balls is not None and np.isfinite(balls[i]).all():
            y, x = np.mgrid[: true.shape[0], : true.shape[1]] + 0.5
            valid = (x - balls[i, 0]) ** 2 + (y - balls[i, 1]) ** 2 > (balls[i, 2] + 2) ** 2
        both, either = (mask & true & valid).sum(), ((mask | true) & valid).sum()
        scores.append(both / max(1, either))
    worst = np.sort(scores)[: max(1, len(scores) // 20)]
    return {
        "person_iou": round(float(np.mean(scores)), 4),
        "person_iou_worst_5_percent": round(float(worst.mean()), 4),
        "without": "the ball" if balls is not None else "nothing: the object is in both masks",
    }


def landmarks_against(raw: RawEstimates, source: Path) -> dict[str, Any]:
    """Pixels between landmarks."""
    found = np.isfinite(raw.landmarks.image[..., 0]).any(1)
    row: dict[str, Any] = {"frames": len(found), "frames_with_landmarks": int(found.sum())}
    path = source / "pose_mediapipe.npz"
    if not path.is_file():
        return {**row, "landmarks_px": f"not computed: none are supplied with {source.name}"}
    given = np.load(path)["image_xyzv"]
    seen = (given[..., 3] > VISIBLE) & (raw.landmarks.image[..., 3] > VISIBLE)
    off = np.linalg.norm(given[..., :2] - raw.landmarks.image[..., :2], axis=-1)[seen]
    return {
        **row,
        "frames_with_supplied_landmarks": int(np.isfinite(given[..., 0]).any(1).sum()),
        "landmarks_px_median": round(float(np.median(off)), 3),
        "landmarks_px_95_percent": round(float(np.quantile(off, 0.95)), 3),
    }


if __name__ == "__main__":
    main()
