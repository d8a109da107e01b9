"""A clip trained at once and in windows: scores, and how poses go on where windows meet.

    python benchmarks/chunked.py --json benchmarks/results/chunked.json

Both trainings have the same steps and seeds. A joint is the time where one window ends and the next
begins. Across each, the person's joints (22 of the body) and the object's Gaussians go a step, from
one frame to the next; what is compared is how far that step is from the mean of the steps before
and after it, in windows and at once: a seam would add to it. Exit code 1 if a mean score in windows
is more than 0.2 dB below, or a seam is over 1 cm or 2 degrees.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.model.compose import compose_bodies
from hoigs.runs.loaded_run import LoadedRun
from hoigs.training.train import train

REGIONS = ("full", "human", "object")
SMALL = [
    "model.scene.points=4000", "model.human.points=3000", "model.object.points=800",
    "train.checkpoint_every=100000", "train.preview_every=0",
]  # fmt: skip
LOST, METRES, DEGREES = 0.2, 0.01, 2.0  # dB, and what a seam may be
BODY_JOINTS = 22


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--clip", default="builtin:lift-and-swing?frames=96&width=96&fps=24")
    parser.add_argument("--chunk", type=int, default=16)
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--table", type=Path, metavar="JSON", help="print the docs' table, only")
    arguments = parser.parse_args()
    if arguments.table:
        print(table(json.loads(arguments.table.read_text())))
        return 0
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as temporary:
        for seed in range(arguments.seeds):
            for chunk in (None, arguments.chunk):
                out = Path(temporary) / f"{seed}-{chunk}"
                settings = [*SMALL, f"train.steps={arguments.steps}", f"train.seed={seed}"]
                trained = train(
                    arguments.clip, "hoigs", out=out, overrides=settings, chunk=chunk,
                    device=arguments.device,
                )  # fmt: skip
                assert trained.evaluated is not None
                evaluation = trained.evaluated.evaluation
                scores = {r: evaluation.score(r, "psnr") for r in REGIONS}
                rows.append({
                    "seed": seed, "chunk": chunk, "psnr": scores,
                    "seconds": round(trained.session.trainer.elapsed, 1),
                    **bends(LoadedRun.open(out), arguments.chunk),
                })  # fmt: skip
                print(json.dumps(rows[-1]), flush=True)
    record = {k: getattr(arguments, k) for k in ("clip", "chunk", "steps")} | {"rows": rows}
    print(table(record))
    if arguments.json:
        arguments.json.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    return int(not passes(record))


@torch.no_grad()
def bends(run: LoadedRun, chunk: int) -> dict[str, Any]:
    """Of each joint between windows, the largest of the person's joints (mm, degrees) and of the
    object's Gaussians (mm): the step across it, from the mean of the steps beside it."""
    frames = run.clip.num_frames
    windows = -(-frames // chunk)
    times = {m.index: m for m in run.clip.moments}
    people = {n: run.model.entity(n).deformation for n in run.model.names("human")}
    things = [run.model.entity(n) for n in run.model.names("object")]
    bodies = compose_bodies(run.spec, run.clip)
    found: dict[str, list[float]] = {"body_mm": [], "body_degrees": [], "object_mm": []}
    for k in range(1, windows):
        first = math.ceil(k / windows * (frames - 1))  # the later window's first frame
        around = [times[i] for i in range(first - 2, first + 2)]
        places, turns = [], []
        for name, person in people.items():
            poses = [person.pose(moment) for moment in around]  # type: ignore[operator]
            places.append(torch.stack([bodies[name](p).joints[:BODY_JOINTS] for p in poses]))
            turns.append(torch.stack([_turns(bodies[name], p) for p in poses]))
        found["body_mm"].append(1000 * _largest(torch.cat(places, 1)))
        found["body_degrees"].append(_largest_turn(torch.cat(turns, 1)))
        moved = [torch.stack([thing(m).means for m in around]) for thing in things]
        found["object_mm"].append(1000 * _largest(torch.cat(moved, 1)))
    return {key: [round(v, 3) for v in values] for key, values in found.items()}


def _turns(body: Any, pose: Any) -> Tensor:
    """Orientations of the body's joints in the world, [J, 3, 3]."""
    local = axis_angle_to_matrices(pose.rotations[:BODY_JOINTS])
    world: list[Tensor] = [local[0]]
    for joint in range(1, BODY_JOINTS):
        world.append(world[body.parents[joint]] @ local[joint])
    return torch.stack(world)


def _largest(places: Tensor) -> float:
    """Of points in four frames, [4, P, 3]."""
    steps = places.diff(dim=0)
    return float((steps[1] - (steps[0] + steps[2]) / 2).norm(dim=-1).max())


def _largest_turn(turns: Tensor) -> float:
    """Of orientations in four frames, [4, J, 3, 3]: by the size of the turns, degrees."""
    between = turns[:-1].mT @ turns[1:]
    cosine = (between.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    steps = torch.rad2deg(cosine.clamp(-1, 1).acos())
    return float((steps[1] - (steps[0] + steps[2]) / 2).abs().max())


def means(record: dict[str, Any]) -> dict[str, dict[str, float]]:
    """PSNR by region, at once and in windows, over the seeds."""
    found = {}
    for name, chunked in (("at once", False), ("in windows", True)):
        rows = [r for r in record["rows"] if (r["chunk"] is not None) == chunked]
        found[name] = {k: sum(r["psnr"][k] for r in rows) / len(rows) for k in REGIONS}
    return found


def seams(record: dict[str, Any]) -> dict[str, float]:
    """By how much the largest step across a joint is larger in windows than at once, by measure."""
    by_seed: dict[int, dict[bool, dict[str, Any]]] = {}
    for row in record["rows"]:
        by_seed.setdefault(row["seed"], {})[row["chunk"] is not None] = row
    return {
        key: max(
            b - a
            for pair in by_seed.values()
            for a, b in zip(pair[False][key], pair[True][key], strict=True)
        )
        for key in ("body_mm", "body_degrees", "object_mm")
    }


def passes(record: dict[str, Any]) -> bool:
    mean, seam = means(record), seams(record)
    lost = max(mean["at once"][k] - mean["in windows"][k] for k in REGIONS)
    apart = max(seam["body_mm"], seam["object_mm"]) / 1000
    return lost <= LOST and apart <= METRES and seam["body_degrees"] <= DEGREES


def table(record: dict[str, Any]) -> str:
    """Markdown for the docs."""
    lines = ["| | full, dB | human | object | steps a second |", "|---|---|---|---|---|"]
    for name, chunked in (("at once", False), ("in windows", True)):
        for row in record["rows"]:
            if (row["chunk"] is not None) == chunked:
                cells = " | ".join(f"{row['psnr'][k]:.2f}" for k in REGIONS)
                rate = record["steps"] / row["seconds"]
                lines.append(f"| {name}, seed {row['seed']} | {cells} | {rate:.1f} |")
    mean, seam = means(record), seams(record)
    gains = ", ".join(f"{k} {mean['in windows'][k] - mean['at once'][k]:+.2f} dB" for k in REGIONS)
    largest = {key: max(v for r in record["rows"] if r["chunk"] for v in r[key]) for key in seam}
    lines += ["", (
        f"In windows against at once, mean: {gains}. Across the joints, the step of a frame is at "
        f"most {largest['body_mm']:.1f} mm and {largest['body_degrees']:.2f} degrees (body) and "
        f"{largest['object_mm']:.1f} mm (object) from the mean of its neighbours: "
        f"{seam['body_mm']:+.1f} mm, {seam['body_degrees']:+.2f} degrees and "
        f"{seam['object_mm']:+.1f} mm, at most, against the same frames trained at once."
    )]  # fmt: skip
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
