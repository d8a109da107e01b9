"""What `hoigs prepare X.mp4` makes of a built-in clip of which it has nothing but the pixels.

    python benchmarks/end_to_end.py lift-and-swing carry --train 300 \\
        --json benchmarks/results/end_to_end.json
    python benchmarks/end_to_end.py --table benchmarks/results/end_to_end.json

Each clip is written as an mp4 and prepared with the offline estimators (`hoigs estimators install
mediapipe` comes first), once with a click in the middle of the object in frame 0 and once without;
or, as `alone`, without an object, for the person's figures only.
Compared with the truth are masks of person and object, landmarks, focal length, body, and the
object's place, rotation and shape. `--train` trains on what came out, and on the clip that is
given cameras, masks and poses; both are scored on the true pixels and in the true masks of test
frames.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from estimates.figures import (
    body_figures,
    body_within,
    camera_motion,
    contact_figures,
    draw_masks,
    object_figures,
)
from estimates.source import landmarks, write_video
from estimates.training import Training, trained
from object_tracking import click_on
from prepare_alone import evidence

PROMPTS = ("click", "none", "alone")
VISIBLE = 0.5  # landmarks below are not compared


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("clips", nargs="*", default=["lift-and-swing", "carry", "throw-and-catch"])
    parser.add_argument("--width", type=int, default=512, help="of the video's square frames")
    parser.add_argument("--prompt", nargs="+", choices=PROMPTS, default=PROMPTS[:2])
    parser.add_argument("--train", type=int, default=0, metavar="STEPS")
    parser.add_argument("--train-width", type=int, default=256)
    parser.add_argument("--keep", type=Path, help="folder in which videos, clips and runs stay")
    parser.add_argument("--pictures", type=Path, help="folder for pictures of masks and runs")
    parser.add_argument("--json", type=Path, help="add the rows to this file")
    parser.add_argument("--table", type=Path, help="print the rows of such a file, run nothing")
    args = parser.parse_args()
    if args.table:
        print(table(json.loads(args.table.read_text())))
        return 0
    found = json.loads(args.json.read_text()) if args.json and args.json.is_file() else {}
    for name in args.clips:
        with tempfile.TemporaryDirectory() as temporary:
            rows = measure(name, (args.keep or Path(temporary)).absolute(), args)
            for prompt, row in rows:
                print(name, prompt, json.dumps(row), flush=True)
                found[f"{name}, {prompt}"] = row
                if args.json:
                    half = args.json.with_name(f".{args.json.name}.part")
                    half.write_text(json.dumps(found, indent=1) + "\n")
                    half.replace(args.json)
    return int(any("error" in row for row in found.values()))


def measure(name: str, folder: Path, args: argparse.Namespace) -> Any:
    """Rows of a clip, one for each prompt; "error" in one that could not be prepared."""
    import hoigs
    from hoigs.core.errors import HoigsError
    from hoigs.plugins.bodies.anny import AnnyBody
    from hoigs.plugins.readers.clip import ClipFolderReader
    from hoigs.synthesis.named import named_clip

    body = AnnyBody()
    true_folder = named_clip(f"builtin:{name}?width={args.width}", body)
    truth = ClipFolderReader().read(true_folder)
    folder.mkdir(parents=True, exist_ok=True)
    video, out = folder / f"{name}.mp4", folder / name
    write_video(truth, video)
    how = Training(args.train, args.train_width, pictures=args.pictures)
    given = trained(true_folder, folder / f"{name}.given", how, truth) if args.train else None
    for prompt in args.prompt:
        row: dict[str, Any] = {"frames": len(truth), "width": args.width}
        if prompt == "click":
            x, y, _ = click_on(truth[0].masks["object"].numpy())
            row["object"] = f"{x:.0f},{y:.0f}"
        elif prompt == "alone":
            row["object"] = "none"
        start, used = time.perf_counter(), os.times()
        try:
            report = hoigs.prepare(
                video, out, object=row.get("object", ()), estimators="offline", yes=True,
                overwrite=True,
            )  # fmt: skip
        except HoigsError as error:
            yield prompt, row | {"error": str(error)}
            continue
        row |= {
            "prepare_s": round(time.perf_counter() - start, 1),
            "processor_s": round(sum(os.times()[:4]) - sum(used[:4]), 1),
            "stages_s": {k: round(v, 1) for k, v in report.seconds.items()},
            "warnings": report.warnings,
        }
        made = ClipFolderReader().read(out)
        row |= figures(made, truth, true_folder, out, body)
        if args.pictures:
            draw_masks(made, args.pictures / f"{name}-{prompt}.png")
        if given and len(made) == len(truth):
            row["estimated"] = trained(out, folder / f"{name}-{prompt}.run", how, truth)
            row["given"] = given
        yield prompt, row


def figures(made: Any, truth: Any, true_folder: Path, out: Path, body: Any) -> dict[str, Any]:
    """Everything that can be measured without a training."""
    found = evidence(Path(f"{out}.prepare"))
    row = landmark_figures(np.asarray(found.person.image), truth, body)
    if len(made) != len(truth):
        return row | {"others": f"not computed: {len(made)} of {len(truth)} frames have a camera"}
    row["person_iou"] = overlaps([f.masks["human"] for f in made], truth, "human")
    row["focal_ratio"] = _rounded(made.cameras[0].K[0, 0] / truth.cameras[0].K[0, 0])
    row["scale_ratio"] = scale_ratio(made, truth)
    world = camera_motion(made, truth)
    row |= body_figures(made, truth, body, world)
    row |= body_within(made, truth, body, out)
    if "object" not in made.objects:
        return row | {"object_iou": "not computed: no object was found"}
    row["object_iou"] = overlaps([f.masks["object"] for f in made], truth, "object")
    row |= object_figures(made, truth, true_folder, world)
    return row | contact_figures(made, truth, true_folder, body)


def overlaps(masks: list[Any], truth: Any, name: str) -> dict[str, Any]:
    """Intersection over union: mean, that of the worst 5 %, and frames with an empty mask."""
    scores, empty = [], 0
    for mask, frame in zip(masks, truth, strict=True):
        true = frame.masks[name]
        if not true.any():
            continue
        scores.append(float((mask & true).sum() / (mask | true).sum()))
        empty += not mask.any()
    worst = np.sort(scores)[: max(1, len(scores) // 20)]
    return {"mean": _rounded(np.mean(scores)), "worst": _rounded(worst.mean()), "empty": empty}


def landmark_figures(image: np.ndarray, truth: Any, body: Any) -> dict[str, Any]:
    """Pixels between MediaPipe's landmarks and the points of the true body that they stand for.
    Hidden ones count if MediaPipe calls them visible."""
    true = landmarks(truth, body, (0.0, 0.0), 0)["image_xyzv"]
    seen = np.isfinite(true[..., 0]) & (image[..., -1] > VISIBLE)
    frames = int(np.isfinite(image[..., 0]).any(1).sum())
    if not seen.any():
        return {"frames_with_landmarks": frames, "landmarks_px": "not computed: none is visible"}
    off = np.linalg.norm(image[..., :2] - true[..., :2], axis=-1)[seen]
    return {
        "frames_with_landmarks": frames,
        "landmarks_px": {
            "median": _rounded(np.median(off)),
            "p95": _rounded(np.quantile(off, 0.95)),
        },
    }


def scale_ratio(made: Any, truth: Any) -> float | str:
    """How much larger the clip's world is than the true one, by the cameras' path."""
    spread = []
    for clip in (made, truth):
        centers = np.stack([c.center.numpy() for c in clip.cameras])
        spread.append(np.sqrt(((centers - centers.mean(0)) ** 2).sum(-1).mean()))
    if min(spread) < 0.01:
        return "not computed: the camera stands still"
    return _rounded(spread[0] / spread[1])


def table(found: dict[str, Any]) -> str:
    """Markdown, one line a row."""
    head = (
        "clip, prompt", "person IoU", "object IoU, worst 5 %", "frames without it", "landmarks px",
        "focal", "scale", "joints mm, root-aligned", "joints mm", "about the shoulders: mm, said",
        "within", "distance: mm, said", "within", "object mm", "object °",
        "contact F1",
        "PSNR person + object", "all given",
    )  # fmt: skip
    lines = [head, ("---",) * len(head)]
    for name, row in found.items():
        runs = [row[k]["given poses"]["test frames"]["human_object"]
                if k in row else None for k in ("estimated", "given")]  # fmt: skip
        shown = (
            _at(row, "person_iou", "mean"),
            f"{_at(row, 'object_iou', 'mean')}, {_at(row, 'object_iou', 'worst')}",
            _at(row, "object_iou", "empty"), _at(row, "landmarks_px", "median"),
            row.get("focal_ratio"), row.get("scale_ratio"), row.get("root_aligned_joints_mm"),
            row.get("joints_mm"),
            *(cell for part in ("joints", "distance") for cell in (
                f"{row.get(f'{part}_off_mm')}, {row.get(f'{part}_said_mm')}",
                row.get(f"{part}_within"),
            )),
            _at(row, "place_mm", "mean"), _at(row, "rotation_deg", "median"),
            _at(row, "contact", "f1"),
            *runs,
        )  # fmt: skip
        cells = ["-" if v is None else "still" if str(v).startswith("not") else v for v in shown]
        lines.append((name, *(str(cell) for cell in cells)))
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _at(row: dict[str, Any], key: str, part: str) -> Any:
    value = row.get(key)
    return value[part] if isinstance(value, dict) else "-"


def _rounded(value: Any) -> float:
    return round(float(value), 3)


if __name__ == "__main__":
    sys.exit(main())
