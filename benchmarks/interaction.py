"""What the interaction is worth where the object's track leaves it something to infer.

    python benchmarks/interaction.py lift-and-swing carry throw-and-catch jolted-push --every 8 \\
        --json benchmarks/results/interaction.json
    python benchmarks/interaction.py clips/prepared --every 1 --width 256
    python benchmarks/interaction.py --table benchmarks/results/interaction.json

Each clip is trained by `hoigs` and by `hoigs-no-interaction`. With `--every N` its objects'
poses are known in every N-th frame only; between these they are interpolated (straight lines and
slerp), as a user who placed the object by hand in every N-th frame would have them. `--clip-query`
is added to the names of built-in clips: `object.hidden_share=0.5` turns the back of carry's
person in half of the frames.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.at_size import machine, write
from hoigs.core.maths.rotations import matrices_to_quats, quats_to_matrices, slerp
from hoigs.core.system.npz import load_arrays
from hoigs.evaluation.evaluate import score
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.synthesis.named import named_clip
from hoigs.training.session import Session

REGIONS = ("human_object", "object", "interaction")
SPECS = {"on": "hoigs", "off": "hoigs-no-interaction"}


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("clips", nargs="*", help="built-in clips, or folders")
    parser.add_argument("--every", type=int, default=8, help="frames whose object pose is known")
    parser.add_argument("--clip-query", default="", help="of built-in clips: a=1&b=2")
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--width", type=int, help="of training, pixels; default the clip's")
    parser.add_argument("--ways", nargs="+", choices=SPECS, default=list(SPECS))
    parser.add_argument("--set", action="append", default=[], help="KEY=VALUE of the spec")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--json", type=Path, help="written after each training; rows are added")
    parser.add_argument("--table", type=Path, help="print the table of such a file")
    options = parser.parse_args()
    if options.table:
        print(table(json.loads(options.table.read_text())["rows"]))
        return 0
    known = options.json and options.json.is_file()
    record = json.loads(options.json.read_text()) if known else {"rows": []}
    for name in options.clips:
        with tempfile.TemporaryDirectory() as scratch:
            clip = sparse(folder_of(name, options.clip_query), options.every, Path(scratch))
            for seed in options.seeds:
                for way in options.ways:
                    record["rows"].append(trained(clip, name, way, seed, options))
                    write(record, options.json)
    print(table(record["rows"]))
    return 0


def folder_of(name: str, query: str) -> Path:
    if Path(name).is_dir():
        return Path(name)
    return named_clip(f"builtin:{name}" + (f"?{query}" if query else ""), AnnyBody())


def sparse(folder: Path, every: int, scratch: Path) -> Path:
    """A copy of the clip in which each object's pose is known in every `every`-th frame."""
    clip = scratch / folder.name
    shutil.copytree(folder, clip)
    for file in sorted((clip / "objects").glob("*.npz")) if every > 1 else ():
        arrays = dict(load_arrays(file))
        np.savez(file, **arrays | interpolated(arrays, every))
    return clip


def interpolated(arrays: dict[str, np.ndarray], every: int) -> dict[str, np.ndarray]:
    """Poses between the known frames: straight lines and slerp; known ones are as they were."""
    places = torch.as_tensor(arrays["translations"]).double()
    quats = matrices_to_quats(torch.as_tensor(arrays["rotations"]).double())
    frames = torch.arange(len(places))
    before = frames // every * every
    after = (before + every).clamp(max=len(places) - 1)
    share = ((frames - before) / (after - before).clamp(min=1)).unsqueeze(1).double()
    found = {
        "translations": torch.lerp(places[before], places[after], share),
        "rotations": quats_to_matrices(slerp(quats[before], quats[after], share)),
    }
    known = (frames % every == 0) | (frames == len(places) - 1)
    observed = np.asarray(arrays["observed"]) & known.numpy()
    return {k: v.numpy().astype(arrays[k].dtype) for k, v in found.items()} | {"observed": observed}


def trained(
    clip: Path, name: str, way: str, seed: int, options: argparse.Namespace
) -> dict[str, Any]:
    width = [f"train.width={options.width}"] if options.width else []
    settings = [f"train.steps={options.steps}", f"train.seed={seed}", "train.preview_every=0",
                *width, *options.set]  # fmt: skip
    with tempfile.TemporaryDirectory() as scratch:
        session = Session.open(
            clip, SPECS[way], out=Path(scratch) / "run", device=options.device, overrides=settings
        )
        session.train()
        model = session.trainer.model
        scores = score(model, session.clip, timing_frames=0)
    row: dict[str, Any] = {
        "clip": name, "query": options.clip_query, "every": options.every, "interaction": way,
        "seed": seed, "settings": settings, **machine(model.device),
    }  # fmt: skip
    for view in scores.views:
        short = "path" if view.name == "test frames" else "held out"
        means = {r: view.mean(r, "psnr")[0] for r in REGIONS}
        row[short] = {r: round(v, 2) for r, v in means.items() if isinstance(v, float)}
    place = scores.geometry.get("object_translation")
    row["place_mm"] = round(place, 1) if isinstance(place, float) else None
    print(json.dumps(row), flush=True)
    return row


def table(rows: list[dict[str, Any]]) -> str:
    names = [f"{v}, {r}" for v in ("path", "held out") for r in REGIONS]
    lines = ["| clip | poses of the object known | seed | interaction | " + " | ".join(names)
             + " | object's place mm |", "|---" * (5 + len(names)) + "|"]  # fmt: skip
    for row in rows:
        every = "in all frames" if row["every"] == 1 else f"every {row['every']}th frame"
        clip = row["clip"] + (f"?{row['query']}" if row["query"] else "")
        cells = [row.get(v, {}).get(r, "-") for v in ("path", "held out") for r in REGIONS]
        cells += [row["place_mm"] if row["place_mm"] is not None else "-"]
        lines.append(f"| {clip} | {every} | {row['seed']} | {row['interaction']} | "
                     + " | ".join(map(str, cells)) + " |")  # fmt: skip
    return "\n".join(lines)


if __name__ == "__main__":
    raise SystemExit(main())
