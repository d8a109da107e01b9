"""Quality on views nobody filmed: PSNR of person + object by the angle between camera and path.

    python benchmarks/off_path.py lift-and-swing carry --device cuda --json off-path.json
    python benchmarks/off_path.py lift-and-swing --variant "more=hoigs;model.human.points=30000"
    python benchmarks/off_path.py --table off-path.json

Each variant, a spec with settings, is trained on built-in clips with every pose given, and scored
on test frames of the path, on the clip's own held-out cameras (which stay near the path), and on
cameras turned about the target by each angle, to the left and to the right of the training camera
of their moment. These see sides that no training frame shows.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.at_size import machine, write
from hoigs.core.registry.registry import default_registry
from hoigs.evaluation.evaluate import score
from hoigs.evaluation.scores import ViewScores
from hoigs.runs.clip_source import read_clip
from hoigs.training.session import Session

ANGLES = (15.0, 30.0, 45.0, 60.0, 90.0, 135.0)
EACH = 4  # views of each angle, by turns to the left and to the right
REGION = "human_object"


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("clips", nargs="*")
    parser.add_argument("--variant", action="append", help="NAME=SPEC;SETTING;SETTING…")
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--size", default="", help="of the clips: width=96&height=96&frames=24")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--json", type=Path, help="written after each training")
    parser.add_argument("--pictures", type=Path, help="folder of views, drawn below")
    parser.add_argument("--table", type=Path, help="print the table of such a file")
    options = parser.parse_args()
    if options.table:
        print(table(json.loads(options.table.read_text())))
        return 0
    record: dict[str, Any] = {"command": " ".join(sys.argv), "angles": list(ANGLES), "rows": []}
    for clip in options.clips:
        for variant in options.variant or ["hoigs=hoigs"]:
            for seed in options.seeds:
                record["rows"].append(trained(clip, variant, seed, options))
                write(record, options.json)
    print(table(record))
    return 0


def trained(clip: str, variant: str, seed: int, options: argparse.Namespace) -> dict[str, Any]:
    name, _, rest = variant.partition("=")
    spec, *settings = rest.split(";")
    wide = f"held_out_degrees={','.join(f'{a:g}' for a in ANGLES)}"
    wide = f"builtin:{clip}?{wide}&held_out_views={EACH * len(ANGLES)}"
    near = f"builtin:{clip}" + (f"?{options.size}" if options.size else "")
    wide += f"&{options.size}" if options.size else ""
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as scratch:
        session = Session.open(
            near, spec, out=Path(scratch) / "run", device=options.device, overrides=[
                f"train.steps={options.steps}", f"train.seed={seed}", "train.preview_every=0",
                *settings,
            ],
        )  # fmt: skip
        trained_from = time.perf_counter()
        session.train()
        seconds = time.perf_counter() - trained_from
        model, registry = session.trainer.model, default_registry()
        own = score(model, session.clip, timing_frames=0)
        around = read_clip(wide, registry, None)
        turned = score(model, around, timing_frames=0)
        if options.pictures:
            draw(model, around.held_out, options.pictures / f"{clip}-{name}-{seed}.png")
    row = {
        "clip": clip, "variant": name, "settings": [spec, *settings], "seed": seed,
        "steps": options.steps, "train_s": round(seconds, 1),
        "all_s": round(time.perf_counter() - began, 1), **machine(model.device),
        "path": _mean(own.view("test frames"), range(10**6)),
        "near": _mean(own.view("held-out cameras"), range(10**6)),
    }  # fmt: skip
    for i, angle in enumerate(ANGLES):
        members = {n for n in range(EACH * len(ANGLES)) if n // 2 % len(ANGLES) == i}
        row[f"{angle:g}"] = _mean(turned.view("held-out cameras"), members)
    print(json.dumps(row), flush=True)
    return row


def draw(model: Any, views: Any, file: Path) -> None:
    """One view of each angle, above, and the same drawn by the model, below."""
    columns = []
    for frame in (views[2 * i] for i in range(len(ANGLES))):
        with torch.no_grad():
            camera, moment = frame.camera.to(model.device), frame.moment.to(model.device)
            drawn = model.render(moment, camera).color.clamp(0, 1)
        columns.append(torch.cat((frame.rgb, drawn.cpu())))
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((255 * torch.cat(columns, 1)).byte().numpy()).save(file)


def _mean(view: ViewScores, members: Any) -> float:
    values = [f.values[REGION]["psnr"] for f in view.frames if f.position in members]
    return round(statistics.mean(v for v in values if isinstance(v, float)), 2)


def table(record: dict[str, Any]) -> str:
    angles = [f"{a:g}" for a in record["angles"]]
    heads = ["clip", "variant", "steps", "seed", "path", "near", *(f"{a}°" for a in angles)]
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for row in record["rows"]:
        keys = ("clip", "variant", "steps", "seed", "path", "near", *angles)
        lines.append("| " + " | ".join(str(row[key]) for key in keys) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
