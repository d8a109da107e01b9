"""What `hoigs prepare VIDEO` finds by itself, against what was supplied with a recorded clip.

    python benchmarks/prepare_alone.py juggle backpack coffee --train 400 \\
        --json benchmarks/results/prepare-alone.json
    python benchmarks/prepare_alone.py --table benchmarks/results/prepare-alone.json

Each video is copied alone into an empty folder and prepared with `--estimators offline` and nothing
else given but one click on each object (`--prompt none`: not even that). Compared are:

- the person's mask with the supplied one of person and object, both without the ball where its
  track is supplied: intersection over union, its mean and that of the worst 5 % of frames. The
  supplied masks are MediaPipe's selfie segmentation, one of the three that the mask here is the
  mean of: agreement shows that nothing went wrong, and not that the mask is right.
- the object's mask with the disc of the ball's supplied track. Where there is none the supplied
  masks do not say which pixels are the object's, and those of person and object together are
  compared: these hardly change with the object's mask, which a picture shows better (`--pictures`).
- landmarks, in pixels of the video, median over all that are visible (more than 0.5) in both. The
  supplied ones are of complexity 1, so `--complexity 1` tests the pipe, and 2 (the default) shows
  how far the two models are from each other.
- with `--train`, PSNR of person + object on test frames after a short training on what was found,
  and on the clip that is prepared from the supplied files, both in the masks of the latter. The
  table has those with "blended" poses, as every score of such a clip.
- seconds of each stage, which an idle machine has to be asked for, and seconds of all processors,
  which depend less on what else runs.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from estimates.figures import draw_masks
from estimates.training import Training, trained
from PIL import Image

from hoigs.plugins.readers.clip import ClipFolderReader
from hoigs.preparation.estimates.reader import FoundObject, FrameEstimates
from hoigs.preparation.kept import last_kept
from hoigs.preparation.options import PrepareOptions
from hoigs.preparation.prepare import prepare, prepare_until, work_folder
from hoigs.preparation.prompts import split_name

SHARED = Path(os.environ.get("HOIGS_SHARED", Path(__file__).resolve().parents[2] / "shared"))
CLICKS = {
    "juggle": ["652,324"],
    "backpack": ["250,200"],
    "coffee": ["kettle=460,260@20", "mug=840,440@20"],
}
VISIBLE = 0.5


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("clips", nargs="*", default=list(CLICKS), help="folders of recorded clips")
    parser.add_argument("--prompt", choices=("click", "none"), default="click")
    parser.add_argument("--complexity", type=int, default=2, help="of MediaPipe's model")
    parser.add_argument("--until", help="stop after this stage; default: the whole clip")
    parser.add_argument("--train", type=int, default=0, metavar="STEPS")
    parser.add_argument("--train-width", type=int, default=320)
    parser.add_argument("--keep", type=Path, help="folder in which clips and runs stay")
    parser.add_argument("--pictures", type=Path, help="folder for pictures of objects' masks")
    parser.add_argument("--json", type=Path, help="add the results to this file")
    parser.add_argument("--table", type=Path, help="print the rows of such a file, run nothing")
    args = parser.parse_args()
    if args.table:
        print(table(json.loads(args.table.read_text())))
        return 0
    found = json.loads(args.json.read_text()) if args.json and args.json.is_file() else {}
    for name in args.clips:
        with tempfile.TemporaryDirectory() as temporary:
            row = measure(SHARED / "data" / name, (args.keep or Path(temporary)).absolute(), args)
        print(name, json.dumps(row, indent=1))
        key = f"{name}, {args.prompt}, complexity {args.complexity}"
        found[key] = found.get(key, {}) | row  # a training stays, which --train made earlier
        if args.json:
            args.json.write_text(json.dumps(found, indent=1) + "\n")
    return 0


def measure(source: Path, keep: Path, args: argparse.Namespace) -> dict[str, Any]:
    """One clip's figures."""
    alone = keep / f"{source.name}-alone"
    alone.mkdir(parents=True, exist_ok=True)
    video = Path(shutil.copy(source / "video.mp4", alone))
    use = {"use": "estimator:mediapipe", "complexity": args.complexity}
    options = PrepareOptions.model_validate(
        {"estimators": {"landmarks": use, "masks": use}, "overwrite": True}
    )
    clicks = CLICKS[source.name] if args.prompt == "click" else []
    out, start, before = keep / source.name, time.perf_counter(), processor_seconds()
    common: dict[str, Any] = {
        "object": clicks, "options": options, "estimators": "offline", "yes": True,
    }  # fmt: skip
    if args.until:
        seconds = prepare_until(args.until, video, out, **common)
    else:
        seconds = prepare(video, out, **common).seconds
    row = {
        "seconds": round(time.perf_counter() - start, 1),
        "stages": {stage: round(value, 1) for stage, value in seconds.items()},
        "processor_seconds": round(processor_seconds() - before, 1),
        "cores": os.cpu_count(),
        "load": round(os.getloadavg()[1], 1),
        "machine": platform.machine(),
        "object": clicks or "no prompt",
    }
    raw, found = evidence(work_folder(out)), object_found(work_folder(out))
    row |= {**person_against(raw, source), **landmarks_against(raw, source)}
    if found is not None:
        row |= objects_found(found, clicks) | object_against(raw, found, source)
    if args.pictures and not args.until:
        file = args.pictures / f"{source.name}-{args.prompt}.png"
        draw_masks(ClipFolderReader().read(out), file)
    if args.train and not args.until:
        row |= trained_both(source, out, args)
    return row


def processor_seconds() -> float:
    """Of this process and of the tools that it has run so far."""
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system


def evidence(work: Path) -> FrameEstimates:
    """What the estimators of the person found."""
    found: FrameEstimates = last_kept(work, "estimates")["estimates"]
    return found


def object_found(work: Path) -> FoundObject | None:
    """What the object's estimator found; None before it has."""
    return last_kept(work, "object_masks").get("found_object")


def supplied(source: Path) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Masks of person and object together, and centre and radius of the ball; None: not there."""
    masks, track = source / "hoi_mask", source / "ball_track.npz"
    balls = np.load(track)["xyr"] if track.is_file() else None
    if not masks.is_dir():
        return None, balls
    images = [Image.open(path).convert("L") for path in sorted(masks.glob("*.png"))]
    return np.stack([np.asarray(image) > 127 for image in images]), balls


def disc(shape: tuple[int, int], ball: np.ndarray, wider: float = 0) -> np.ndarray:
    """Pixels of the ball; none in a frame in which it is not known."""
    y, x = np.mgrid[: shape[0], : shape[1]] + 0.5
    found: np.ndarray = (x - ball[0]) ** 2 + (y - ball[1]) ** 2 <= (ball[2] + wider) ** 2
    return found


def person_against(raw: FrameEstimates, source: Path) -> dict[str, Any]:
    """Intersection over union of the person's masks."""
    human, (together, balls) = raw.masks.human, supplied(source)
    if human is None or together is None:
        return {"person_iou": f"not computed: no masks are supplied with {source.name}"}
    scores = []
    for i, (mask, true) in enumerate(zip(human, together, strict=True)):
        valid = np.ones_like(true) if balls is None else ~disc(true.shape, balls[i], 2)
        scores.append(_overlap(mask & valid, true & valid))
    return {
        **_scored("person_iou", scores),
        "without": "the ball" if balls is not None else "nothing: the object is in both masks",
    }


def object_against(raw: FrameEstimates, found: FoundObject, source: Path) -> dict[str, Any]:
    """Intersection over union of the object's masks, or of person and object together."""
    together, balls = supplied(source)
    if balls is not None:
        known = np.isfinite(balls).all(1)
        pairs = zip(found.masks, balls, known, strict=True)
        scores = [_overlap(mask, disc(mask.shape, ball)) for mask, ball, k in pairs if k]
        return {**_scored("object_iou", scores), "object_against": "the ball's supplied track"}
    if together is None or raw.masks.human is None:
        return {"object_iou": f"not computed: no masks are supplied with {source.name}"}
    triples = zip(found.masks, raw.masks.human, together, strict=True)
    scores = [_overlap(mask | human, true) for mask, human, true in triples]
    return {
        "object_iou": f"not computed: {source.name}'s supplied masks do not set the object apart",
        **_scored("person_and_object_iou", scores),
    }


def objects_found(found: FoundObject, clicks: list[str]) -> dict[str, Any]:
    """Frames without each object, its share of the image, and what the tracker says of it."""
    first = split_name(clicks[0])[0] if clicks else ""
    every = {first or "object": found, **found.further}
    sizes = {n: [float(m.mean()) for m in f.masks] for n, f in every.items()}
    return {
        "frames_without": {n: sum(s == 0 for s in size) for n, size in sizes.items()},
        "object_percent_of_image": {
            n: round(100 * float(np.median(size)), 2) for n, size in sizes.items()
        },
        "notes": list(found.notes),
    }


def _overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max(1, (a | b).sum()))


def _scored(name: str, scores: list[float]) -> dict[str, float]:
    worst = np.sort(scores)[: max(1, len(scores) // 20)]
    return {
        name: round(float(np.mean(scores)), 4),
        f"{name}_worst_5_percent": round(float(worst.mean()), 4),
    }


def landmarks_against(raw: FrameEstimates, source: Path) -> dict[str, Any]:
    """Pixels between landmarks."""
    found = np.isfinite(np.asarray(raw.person.image)[..., 0]).any(1)
    row: dict[str, Any] = {"frames": len(found), "frames_with_landmarks": int(found.sum())}
    path = source / "pose_mediapipe.npz"
    if not path.is_file():
        return {**row, "landmarks_px": f"not computed: none are supplied with {source.name}"}
    given = np.load(path)["image_xyzv"]
    seen = (given[..., 3] > VISIBLE) & (raw.person.image[..., 2].numpy() > VISIBLE)
    off = np.linalg.norm(given[..., :2] - raw.person.image[..., :2].numpy(), axis=-1)[seen]
    return {
        **row,
        "frames_with_supplied_landmarks": int(np.isfinite(given[..., 0]).any(1).sum()),
        "landmarks_px_median": round(float(np.median(off)), 3),
        "landmarks_px_95_percent": round(float(np.quantile(off, 0.95)), 3),
    }


def trained_both(source: Path, out: Path, args: argparse.Namespace) -> dict[str, Any]:
    """Scores of trainings on the clip that was found and on that of the supplied files."""
    if not (source / "pose_mediapipe.npz").is_file():
        return {"psnr": f"not computed: nothing is supplied with {source.name}"}
    given = out.with_name(f"{out.name}-supplied")
    prepare(source, given, estimators="files", options=PrepareOptions(overwrite=True))
    truth, made = (ClipFolderReader().read(folder) for folder in (given, out))
    if len(truth) != len(made):
        return {"psnr": f"not computed: {len(made)} frames, and {len(truth)} of supplied files"}
    scored = out.with_name(f"{out.name}-scored")
    shutil.rmtree(scored, ignore_errors=True)
    shutil.copytree(out, scored)
    shutil.rmtree(scored / "masks")
    shutil.copytree(given / "masks", scored / "masks")
    how = Training(args.train, args.train_width)
    alone = trained(out, out.with_name(f"{out.name}.run"), how, ClipFolderReader().read(scored))
    supplied = trained(given, out.with_name(f"{out.name}-supplied.run"), how)
    return {"train_steps": args.train, "alone": alone, "supplied": supplied}


def table(found: dict[str, Any]) -> str:
    """Markdown, one line a row."""
    head = (
        "clip, prompt", "person IoU, worst 5 %", "object IoU, worst 5 %", "person + object",
        "frames without it", "landmarks px", "seconds, of processors", "PSNR person + object",
        "from supplied files",
    )  # fmt: skip
    lines = [head, ("---",) * len(head)]
    for name, row in found.items():
        scores = [
            f"{row[key]:.2f}, {row[f'{key}_worst_5_percent']:.2f}"
            if isinstance(row.get(key), float) else "-"
            for key in ("person_iou", "object_iou", "person_and_object_iou")
        ]  # fmt: skip
        runs = [
            row[key]["blended poses"]["test frames"]["human_object"] if key in row else "-"
            for key in ("alone", "supplied")
        ]
        without = ", ".join(str(n) for n in row.get("frames_without", {}).values()) or "-"
        cells = (
            name, *scores, without, row.get("landmarks_px_median", "-"),
            f"{row['seconds']:.0f}, {row['processor_seconds']:.0f}", *runs,
        )  # fmt: skip
        lines.append(tuple(str(cell) for cell in cells))
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


if __name__ == "__main__":
    sys.exit(main())
