"""Number of torch operations that compute the Gaussians of a frame, by line of code.

    python benchmarks/operations.py runs/mine runs/other

Measured in `Playback`, without what does not depend on time. Views are not counted. On a GPU each
operation is at least one kernel launch, which dominate the time of small models.
"""

from __future__ import annotations

import argparse
import traceback
from collections import Counter
from pathlib import Path
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from hoigs.runs.loaded_run import LoadedRun
from hoigs.viewing.playback import Playback

VIEWS = {
    "_reshape_alias", "_unsafe_view", "alias", "as_strided", "detach", "diagonal", "expand",
    "permute", "select", "slice", "split", "split_with_sizes", "squeeze", "t", "transpose",
    "unbind", "unflatten", "unsqueeze", "view",
}  # fmt: skip


class Counting(TorchDispatchMode):
    """Counts operations by the two innermost lines of hoigs."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: Counter[str] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func._schema.name.partition("::")[2] not in VIEWS:
            own = [f for f in traceback.extract_stack() if "/hoigs/" in f.filename]
            inner = reversed(own[-2:])
            self.lines[" < ".join(f"{f.name}:{f.lineno}" for f in inner)] += 1
        return func(*args, **(kwargs or {}))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--lines", type=int, default=10, help="to name")
    options = parser.parse_args()
    for run in options.runs:
        loaded = LoadedRun.open(run)
        clip = loaded.clip
        views = [(clip.moments[p], clip.cameras[p]) for p in clip.split["test"][:3]]
        film = Playback(loaded.model, views)
        with torch.no_grad(), Counting() as counting:
            film.deform(*views[1])
        print(f"{run}: {counting.lines.total()} operations place a frame")
        for line, count in counting.lines.most_common(options.lines):
            print(f"  {count:4} {line}")


if __name__ == "__main__":
    main()
