"""Which `min_gain` for a doubling of parameters finds what clips of known truth need, offline.

    python benchmarks/needs_min_gain.py --jobs 21 --threads 1
    python benchmarks/needs_min_gain.py --summary --cells benchmarks/results/needs-min-gain.json

Every candidate of the object's search space is trained to its end on the clips of `needs_truth.py`,
and scored where a search would score it. Successive halving is then replayed at every `min_gain`.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import Any

from many_cells import read_cell, run_cells, write_cell
from needs_truth import CASES, search_of

SPACE = "object"
MIN_GAINS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
SEEDS = {"bend": range(8), "glide": range(8), "still": (0, 2, 6), "throw": (0,), "eight": (0,)}
# the refit, which is not replayed here, finds that a static object needs no knots
REFITTED = ("rigid, 2 knots", "rigid, 3 knots", "rigid, adaptive knots")


def every_candidate(case: str, seed: int, options: argparse.Namespace) -> dict[str, Any]:
    """Scores of all candidates at all steps at which a search would score them."""
    from hoigs.studies.needs.result import Answer
    from hoigs.studies.needs.search import Search
    from hoigs.studies.needs.search_space import SearchSpace, plan

    found: dict[str, Any] = {}

    class Every(Search):
        def _answer(self, space: SearchSpace, block: str, budget: float) -> Answer:
            if space.name == SPACE:
                rounds = plan([r.cost for r in space.candidates], budget, len(self.held), self.most)
                blocks = self.blocks | {space.kind: [block]}
                trials, _ = self._trials(space, block, blocks, rounds.steps)
                scores = {
                    name: {until: trial.advance(until) for until in rounds.until}
                    for name, trial in trials.items()
                }
                found["alive"], found["until"] = rounds.alive, rounds.until
                found["scores"] = {
                    name: {"parameters": trials[name].parameters,
                           "psnr": {until: score.psnr for until, score in of.items()}}
                    for name, of in scores.items()
                }  # fmt: skip
            return Answer(space, block, None, skipped="scored only")

    search_of(CASES[case], seed, options, Every).run()
    return found


def replayed(cell: dict[str, Any], min_gain: float) -> str:
    """The candidate that successive halving chooses with a `min_gain`."""
    from hoigs.studies.needs.result import Settings
    from hoigs.studies.needs.search_space import Plan, Rule, Score, StepBudget, successive_halving

    names = list(cell["scores"])

    def score(k: int, until: int) -> Score:
        of = cell["scores"][names[k]]
        psnr = tuple(of["psnr"][str(until)])
        return Score(psnr, (0.0,) * len(psnr), (1,) * len(psnr), of["parameters"])

    rounds = Plan(tuple(cell["alive"]), tuple(cell["until"]))
    frames = len(score(0, rounds.until[0]).psnr)
    halving = successive_halving(rounds, [1.0] * len(names), frames, score, StepBudget(math.inf),
                    rule=Rule(least=Settings().least, min_gain=min_gain))  # fmt: skip
    return names[halving.chosen]


def right(case: str, candidate: str) -> bool:
    wanted = CASES[case].right[SPACE]
    return candidate in wanted or (case == "still" and candidate in REFITTED)


def summary(cells: dict[str, Any]) -> None:
    """For each `min_gain`, the cells with a wrong choice."""
    print(f"| min_gain, dB a doubling | wrong of {len(cells)} | |\n|---:|---:|---|")
    for min_gain in MIN_GAINS:
        chosen = {name: replayed(cell, min_gain) for name, cell in cells.items()}
        wrong = [f"{n}: {r}" for n, r in chosen.items() if not right(n.partition("-")[0], r)]
        print(f"| {min_gain:g} | {len(wrong)} | {'; '.join(wrong)} |")


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=1200, help="of a full training")
    parser.add_argument("--frames", type=int, default=48)
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--share", type=float, default=0.15, help="of training frames, held back")
    parser.add_argument("--jobs", type=int, default=1, help="cells at a time")
    parser.add_argument("--threads", type=int, default=1, help="of each")
    parser.add_argument("--minutes", type=float, help="stop then; the same command goes on")
    parser.add_argument("--out", type=Path, default=Path("runs/needs-min-gain"))
    parser.add_argument("--summary", action="store_true", help="only read what is done")
    parser.add_argument("--cells", type=Path, help="JSON of all cells, to read or to write")
    parser.add_argument("--cell", help=argparse.SUPPRESS)
    options = parser.parse_args()
    return argparse.Namespace(**vars(options), all=False)


def main() -> int:
    options = parse()
    settings = {name: getattr(options, name) for name in ("steps", "frames", "size", "share")}
    if options.cell is not None:
        case, _, seed = options.cell.rpartition("-")
        found = every_candidate(case, int(seed), options)
        write_cell(options.out, options.cell, settings, found)
        return 0
    names = [f"{case}-{seed}" for case, seeds in SEEDS.items() for seed in seeds]
    if not options.summary:
        own = [f"--{key}={value}" for key, value in settings.items()]
        run_cells(
            names, options.out, settings, [*own, "--out", str(options.out)],
            jobs=options.jobs, threads=options.threads, minutes=options.minutes,
        )  # fmt: skip
    if options.summary and options.cells is not None:
        cells = json.loads(options.cells.read_text())["cells"]
    else:
        read = {name: read_cell(options.out, name, settings) for name in names}
        cells = {name: cell for name, cell in read.items() if cell is not None}
        if options.cells is not None:
            options.cells.write_text(json.dumps({"settings": settings, "cells": cells}))
    summary(cells)
    return 0


if __name__ == "__main__":
    sys.exit(main())
