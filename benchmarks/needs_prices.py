"""Which `price` of a doubling of numbers finds what clips of known truth need, offline.

    python benchmarks/needs_prices.py --jobs 21 --threads 1
    python benchmarks/needs_prices.py --summary --cells benchmarks/results/needs-prices.json

Every rung of the object's ladder is trained to its end on clips of `needs_truth.py`, and looked at
where a search would look. Successive halving is then played through those scores at every price.
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

LADDER = "object"
PRICES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
SEEDS = {"bend": range(8), "glide": range(8), "still": (0, 2, 6), "throw": (0,), "eight": (0,)}
# what stands still needs no more knots, which the refit finds; that is not played here
REFITTED = ("rigid, 2 knots", "rigid, 3 knots", "rigid, adaptive knots")


def every_rung(case: str, seed: int, options: argparse.Namespace) -> dict[str, Any]:
    """Scores of all rungs at all steps at which a search would look."""
    from hoigs.studies.needs.halving import plan
    from hoigs.studies.needs.rungs import Ladder
    from hoigs.studies.needs.search import Answer, Search

    found: dict[str, Any] = {}

    class Every(Search):
        def _answer(self, ladder: Ladder, block: str, budget: float) -> Answer:
            if ladder.name == LADDER:
                rounds = plan([r.cost for r in ladder.rungs], budget, len(self.held), self.most)
                blocks = self.blocks | {ladder.kind: [block]}
                trials, _ = self._trials(ladder, block, blocks, rounds.steps)
                looks = {
                    name: {until: trial.advance(until) for until in rounds.until}
                    for name, trial in trials.items()
                }
                found["alive"], found["until"] = rounds.alive, rounds.until
                found["looks"] = {
                    name: {"parameters": trials[name].parameters,
                           "psnr": {until: score.psnr for until, score in of.items()}}
                    for name, of in looks.items()
                }  # fmt: skip
            return Answer(ladder, block, None, skipped="only looked at")

    search_of(CASES[case], seed, options, Every).run()
    return found


def played(cell: dict[str, Any], price: float) -> str:
    """The rung that successive halving takes at a price."""
    from hoigs.studies.needs.criterion import Score
    from hoigs.studies.needs.halving import Ledger, Plan, climb
    from hoigs.studies.needs.search import Settings

    names = list(cell["looks"])

    def look(k: int, until: int) -> Score:
        of = cell["looks"][names[k]]
        psnr = tuple(of["psnr"][str(until)])
        return Score(psnr, (0.0,) * len(psnr), (1,) * len(psnr), of["parameters"])

    rounds = Plan(tuple(cell["alive"]), tuple(cell["until"]))
    frames = len(look(0, rounds.until[0]).psnr)
    climbed = climb(rounds, [1.0] * len(names), frames, look, Ledger(math.inf),
                    least=Settings().least, price=price)  # fmt: skip
    return names[climbed.chosen]


def right(case: str, rung: str) -> bool:
    wanted = CASES[case].right[LADDER]
    return rung in wanted or (case == "still" and rung in REFITTED)


def summary(cells: dict[str, Any]) -> None:
    """At each price, which cells would go wrong."""
    print(f"| price, dB a doubling | wrong of {len(cells)} | |\n|---:|---:|---|")
    for price in PRICES:
        chosen = {name: played(cell, price) for name, cell in cells.items()}
        wrong = [f"{n}: {r}" for n, r in chosen.items() if not right(n.partition("-")[0], r)]
        print(f"| {price:g} | {len(wrong)} | {'; '.join(wrong)} |")


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=1200, help="of a full training")
    parser.add_argument("--frames", type=int, default=48)
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--share", type=float, default=0.15, help="of training frames, held back")
    parser.add_argument("--jobs", type=int, default=1, help="cells at a time")
    parser.add_argument("--threads", type=int, default=1, help="of each")
    parser.add_argument("--minutes", type=float, help="stop then; the same command goes on")
    parser.add_argument("--out", type=Path, default=Path("runs/needs-prices"))
    parser.add_argument("--summary", action="store_true", help="only read what is done")
    parser.add_argument("--cells", type=Path, help="JSON of all cells, to read or to write")
    parser.add_argument("--cell", help=argparse.SUPPRESS)
    options = parser.parse_args()
    return argparse.Namespace(**vars(options), all=False, criterion="one-se")


def main() -> int:
    options = parse()
    settings = {name: getattr(options, name) for name in ("steps", "frames", "size", "share")}
    if options.cell is not None:
        case, _, seed = options.cell.rpartition("-")
        found = every_rung(case, int(seed), options)
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
