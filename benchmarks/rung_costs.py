"""What a step of each rung's trial costs, over a step of the full spec: `cost` in ladders.yaml.

    python benchmarks/rung_costs.py
    python benchmarks/rung_costs.py --clip "builtin:lift-and-swing?width=96&frames=48&fps=12" \
        --set model.human.points=2000 --set model.human.deformation.resolution=32

Nothing is chosen: every ladder is tried over the spec as it is.
"""

from __future__ import annotations

import argparse
import os
import time
from typing import Any


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clip", default="builtin:lift-and-swing")
    parser.add_argument("--spec", default="hoigs")
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--steps", type=int, default=8, help="timed, after four")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = str(options.threads)

    import torch

    from hoigs.studies.needs.rungs import Ladder, load_ladders
    from hoigs.studies.needs.search import Answer, Search
    from hoigs.training.session import read_clip

    torch.set_num_threads(options.threads)
    paces: list[float] = []

    def seconds(trial: Any) -> float:
        trial.trainer.train(until=4)
        began = time.perf_counter()
        trial.trainer.train(until=4 + options.steps)  # its history reads the last loss: in sync
        return (time.perf_counter() - began) / options.steps

    class Timed(Search):
        def _pace(self, full: Any, steps: int = 6) -> float:
            paces.append(super()._pace(full, 4 + options.steps))
            print(f"full step: {1000 * paces[0]:.1f} ms")
            print(f"{'ladder':16} {'rung':40} {'declared':>8} {'measured':>8}")
            return paces[0]

        def _answer(self, ladder: Ladder, block: str, budget: float) -> Answer:
            del budget
            blocks = self.blocks if not block else self.blocks | {ladder.kind: [block]}
            trials, _ = self._trials(ladder, block, blocks, 200)
            for rung in ladder.rungs:
                if rung.name in trials:
                    share = seconds(trials[rung.name]) / paces[0]
                    print(f"{ladder.name:16} {rung.name:40} {rung.cost:8.2f} {share:8.2f}")
            return Answer(ladder, block, None, skipped="only timed")

    given = ("train.steps=2000", *options.set)
    clip = read_clip(options.clip)
    Timed(clip, options.spec, load_ladders(), given, device=options.device).run()


if __name__ == "__main__":
    main()
