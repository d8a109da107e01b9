"""Cost of a trial step of each candidate, relative to the full spec: `cost` in search_spaces.yaml.

    python benchmarks/candidate_costs.py
    python benchmarks/candidate_costs.py --clip "builtin:lift-and-swing?width=96&frames=48&fps=12" \
        --set model.human.points=2000 --set model.human.deformation.resolution=32

No candidate is chosen: every search space is tried with the spec unchanged.
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

    from hoigs.runs.clip_source import read_clip
    from hoigs.studies.needs.result import Answer
    from hoigs.studies.needs.search import Search
    from hoigs.studies.needs.search_space import SearchSpace, load_search_spaces

    torch.set_num_threads(options.threads)
    paces: list[float] = []

    def seconds(trial: Any) -> float:
        trial.trainer.train(until=4)
        began = time.perf_counter()
        trial.trainer.train(until=4 + options.steps)  # its history reads the last loss: in sync
        return (time.perf_counter() - began) / options.steps

    class Timed(Search):
        def _pace(self, steps: int = 6) -> float:
            del steps
            paces.append(super()._pace(4 + options.steps))
            print(f"full step: {1000 * paces[0]:.1f} ms")
            print(f"{'search space':16} {'candidate':40} {'declared':>8} {'measured':>8}")
            return paces[0]

        def _answer(self, space: SearchSpace, block: str, budget: float) -> Answer:
            del budget
            blocks = self.blocks if not block else self.blocks | {space.kind: [block]}
            trials, _ = self._trials(space, block, blocks, 200)
            for candidate in space.candidates:
                if candidate.name in trials:
                    share = seconds(trials[candidate.name]) / paces[0]
                    print(f"{space.name:16} {candidate.name:40} {candidate.cost:8.2f} {share:8.2f}")
            return Answer(space, block, None, skipped="only timed")

    given = ("train.steps=2000", *options.set)
    clip = read_clip(options.clip)
    Timed(clip, options.spec, load_search_spaces(), given, device=options.device).run()


if __name__ == "__main__":
    main()
