"""How much each fault of a clip costs: `hoigs` trained on a clean clip and on degraded ones.

    python benchmarks/degradations.py
    python benchmarks/degradations.py --only clean depth-x0.8 --steps 200 --json drops.json

Every clip is the built-in one with one setting of `SceneConfig.noise`; training allows faults.
Models are scored against the frames, masks and depth of the clean clip, so that only the training
data differ; where poses or the number of frames differ, against the degraded clip's own test
frames.
Held-out cameras are exact and the same everywhere. `named` lists the kinds of fault that the run
reported.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

FAULTS = {
    "clean": "",
    "depth-x0.8": "noise.depth_scale=0.8",
    "depth-x1.25": "noise.depth_scale=1.25",
    "depth-nan": "noise.depth_nan=0.2",
    "masks-flipped": "noise.mask_boundary=0.2",
    "masks-zero": "noise.mask_missing=0.1",
    "masks-absent": "noise.mask_absent=0.1",
    "poses-3deg": "noise.pose_degrees=3",
    "frames-dropped": "noise.frames_dropped=0.1",
    "frames-absent": "noise.frames_absent=0.1",
}
OWN = ("poses-3deg", "frames-dropped", "frames-absent")  # scored against their own test frames
LIMITED = ("depth-x0.8", "depth-x1.25", "depth-nan", "masks-flipped", "masks-zero", "masks-absent")
LIMIT_DB = 1.5


def measure(fault: str, options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """One clip trained on and scored."""
    from hoigs.evaluation.evaluate import score
    from hoigs.runs.clip_source import read_clip
    from hoigs.runs.loaded_run import LoadedRun
    from hoigs.training.session import Session

    base = (
        f"builtin:lift-and-swing?width={options.width}&frames={options.frames}&edge_samples=4"
        "&held_out_views=6"
    )
    clip = f"{base}&{FAULTS[fault]}" if FAULTS[fault] else base
    changes = [
        f"train.steps={options.steps}", "train.preview_every=0", "model.scene.points=6000",
        "model.scene.density.cap=9000", "model.human.points=5000", "model.object.points=1000",
        *options.set,
    ]  # fmt: skip
    run = folder / fault
    session = Session.open(clip, "hoigs", out=run, overrides=changes, allow_faults=True)
    started = time.perf_counter()
    session.train()
    seconds = time.perf_counter() - started
    loaded = LoadedRun.open(run, clip=clip)
    judged = loaded.clip if fault in OWN else read_clip(base, width=options.width)
    scores = score(loaded.model, judged, timing_frames=0)
    return {
        "fault": fault,
        "clip": clip,
        "named": sorted({f.kind for f in session.faults}),
        "lines": [str(f) for f in session.faults],
        "train_s": round(seconds, 1),
        "skipped_steps": len(session.trainer.guard.skipped),
        "psnr": {
            region: scores.score(region, "psnr") for region in ("full", "human_object", "object")
        },
        "held_out_psnr": scores.score("full", "psnr", "held-out cameras"),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description="PSNR that each fault of a clip costs")
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--width", type=int, default=128)
    parser.add_argument("--frames", type=int, default=32)
    parser.add_argument("--only", nargs="+", choices=FAULTS, default=list(FAULTS))
    parser.add_argument("--set", action="append", default=[], help="override of the spec")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="degradations-"))
    rows: list[dict[str, Any]] = []
    print(
        f"{'clip':16}{'full':>8}{'drop':>7}{'h+o':>8}{'drop':>7}{'held out':>10}{'drop':>7}  named"
    )
    try:
        for fault in dict.fromkeys(["clean", *options.only]):
            row = measure(fault, options, folder)
            rows.append(row)
            clean = rows[0]
            row["drop"] = {k: clean["psnr"][k] - v for k, v in row["psnr"].items()}
            row["held_out_drop"] = clean["held_out_psnr"] - row["held_out_psnr"]
            print(
                f"{fault:16}{row['psnr']['full']:9.2f}{row['drop']['full']:9.2f}"
                f"{row['psnr']['human_object']:9.2f}{row['drop']['human_object']:9.2f}"
                f"{row['held_out_psnr']:9.2f}{row['held_out_drop']:9.2f}  "
                f"{', '.join(row['named']) or '-'}",
                flush=True,
            )
            if options.json:
                record = {"steps": options.steps, "width": options.width, "rows": rows}
                temporary = options.json.with_name(f".{options.json.name}.{os.getpid()}.part")
                temporary.write_text(json.dumps(record, indent=1) + "\n")
                temporary.replace(options.json)
    finally:
        shutil.rmtree(folder)
    over = [r["fault"] for r in rows if r["fault"] in LIMITED and r["drop"]["full"] >= LIMIT_DB]
    unnamed = [r["fault"] for r in rows if r["fault"] != "clean" and not r["named"]]
    for what, found in ((f"cost {LIMIT_DB} dB or more", over), ("were not named", unnamed)):
        if found:
            print(f"{', '.join(found)} {what}", file=sys.stderr)
    return 1 if over or unnamed else 0


if __name__ == "__main__":
    sys.exit(main())
