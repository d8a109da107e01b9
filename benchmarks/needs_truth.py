"""Does `hoigs needs` find what clips of known truth need? Right or wrong, case by case and seed.

    python benchmarks/needs_truth.py
    python benchmarks/needs_truth.py --only still glide --seeds 2 --steps 600 --json needs.json

A seed is of the clip (textures, points, jolts) and of the training. Only the ladders that a case
speaks of are climbed, so that they share the budget of a full search between them.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path

RIGID_FEW = ("rigid, 2 knots", "rigid, 3 knots")
RIGID_MANY = ("rigid, adaptive knots",)
BEYOND = ("articulated", "rigid and residual", "per Gaussian")


@dataclass(frozen=True)
class Case:
    """A clip, and the rungs that are right for it, by ladder."""

    clip: str
    right: dict[str, tuple[str, ...]]


CASES = {
    "still": Case("still-box", {"object": ("static",), "interaction": ("off",)}),
    "glide": Case("glide", {"object": RIGID_FEW}),
    "eight": Case("figure-eight", {"object": RIGID_MANY}),
    "throw": Case("throw-and-catch", {"object": RIGID_MANY}),
    "bend": Case("bending-bar", {"object": BEYOND}),
    "push": Case("jolted-push", {"interaction": ("object only", "both")}),
}


def run(case: Case, seed: int, options: argparse.Namespace) -> dict[str, object]:
    """One search; what was chosen, and whether that is right."""
    from hoigs.studies.needs.rungs import load_ladders
    from hoigs.studies.needs.search import Search, Settings, told
    from hoigs.training.session import read_clip

    size = options.size
    clip = read_clip(
        f"builtin:{case.clip}?frames={options.frames}&fps={options.frames / 4}&width={size}"
        f"&samples=1&edge_samples=1&held_out_views=0&test_frames={options.frames // 8}"
        f"&scene_points=1000&object_points=600&seed={seed}"
    )
    wanted = {"object", *case.right}  # what the others ask about
    ladders = [ladder for ladder in load_ladders() if ladder.name in wanted]
    given = (f"train.steps={options.steps}", f"train.seed={seed}",
             "model.human.points=2000", "model.human.deformation.resolution=32")  # fmt: skip
    began = time.perf_counter()
    needs = Search(clip, "hoigs", ladders, given, Settings(options.criterion)).run()
    chosen = {a.ladder.name: a.chosen.name for a in needs.answers if a.chosen is not None}
    return {
        "chosen": chosen,
        "right": all(chosen[name] in rungs for name, rungs in case.right.items()),
        "because": [told(answer) for answer in needs.answers],
        "seconds": round(time.perf_counter() - began, 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--steps", type=int, default=600, help="of a full training")
    parser.add_argument("--frames", type=int, default=32)
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--criterion", choices=["one-se", "bic"], default="one-se")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    results: dict[str, list[dict[str, object]]] = {}
    for name in options.only:
        case = CASES[name]
        for seed in range(options.seeds):
            found = run(case, seed, options)
            results.setdefault(name, []).append(found)
            word = "right" if found["right"] else "WRONG"
            print(f"{name} seed {seed}: {word} {found['chosen']} {found['seconds']} s", flush=True)
            for line in found["because"] if isinstance(found["because"], list) else ():
                print(f"    {line}", flush=True)
    for name, rows in results.items():
        print(f"{name}: right in {sum(bool(r['right']) for r in rows)} of {len(rows)}")
    if options.json:
        options.json.write_text(json.dumps(results, indent=1))
    if not all(row["right"] for rows in results.values() for row in rows):
        sys.exit(1)


if __name__ == "__main__":
    main()
