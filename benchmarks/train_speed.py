"""Milliseconds of a hoigs training step by part, with the real trainer, and what 30k steps take.

    python benchmarks/train_speed.py --json train-speed.json --out runs/speed
    python benchmarks/train_speed.py --device cpu --size 64x36 --splats 500 200 80 --steps 6

The trainer is `hoigs train`'s own, past its warm-ups (as they end within a fifth of a run), on a
built-in clip whose frames are decoded once before. Its parts are timed by wrapping the methods that
it calls; a part does not include the parts inside it.

    frame      the clip's frame, its upload and its crops are in `loss`
    deform     SceneModel: features, interaction, deformation, or the replay of them
    raster     all forward renders of the step
    loss       the objective, without the two above
    backward   all of it, rasterizer included
    guard, optimiser, density, rest

`step_ms` is the wall time of a step without any waiting, over all steps; `host_ms` is what Python
spends in each part meanwhile; `waited_ms`, from other steps, has the device finish each part before
the next. Operations are those that a dispatch mode sees in a step, views apart; the profiler counts
launches, on CUDA.

`--graphs` is `train.graphs`; "both" measures first without CUDA graphs, then with those of the
scene alone, then with those of whole steps, on one model; `loss` is then all of a step's replay.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from torch.utils._python_dispatch import TorchDispatchMode

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.at_size import (
    Size,
    add_size,
    clip_name,
    clock,
    machine,
    middle,
    spec_overrides,
    write,
)
from hoigs.core.values.clip import Clip
from hoigs.training.graphs import GraphedScene
from hoigs.training.session import Session
from hoigs.training.step_graph import StepGradients
from hoigs.training.trainer import Trainer

LONG_RUN = 30_000
# what is wrapped: attribute path from the trainer, and the part that its time counts as
WRAPPED = (
    ("objective._deform", "deform"),
    ("model.draw", "raster"),
    ("gradients", "loss"),
    ("optimizer.step", "optimiser"),
    ("optimizer.zero_grad", "optimiser"),
    ("_evolve", "density"),
    ("_refine", "density"),
)


class Parts:
    """Time in parts, each without the parts inside it."""

    def __init__(self, device: torch.device, *, wait: bool) -> None:
        self.device, self.wait = device, wait
        self.spent: dict[str, float] = defaultdict(float)
        self._open: list[str] = []
        self._since = 0.0

    def now(self) -> float:
        return clock(self.device) if self.wait else 1e3 * time.perf_counter()

    def switch(self, part: str | None) -> None:
        """Count the time so far, and go into a part, or out of the last one (None)."""
        now = self.now()
        if self._open:
            self.spent[self._open[-1]] += now - self._since
        if part is None:
            self._open.pop()
        else:
            self._open.append(part)
        self._since = now

    def timed(self, function: Callable[..., Any], part: str) -> Callable[..., Any]:
        def inside(*args: Any, **kwargs: Any) -> Any:
            self.switch(part)
            try:
                return function(*args, **kwargs)
            finally:
                self.switch(None)

        return inside


@contextmanager
def watched(trainer: Trainer, parts: Parts) -> Iterator[None]:
    """The trainer with its parts timed."""
    import hoigs.training.trainer as home

    undo = []
    for path, part in WRAPPED:
        *way, name = path.split(".")
        owner: Any = trainer
        for step in way:
            owner = getattr(owner, step)
        kept = vars(owner).get(name)
        object.__setattr__(owner, name, parts.timed(getattr(owner, name), part))
        undo.append((owner, name, kept))
    guard = parts.timed(home.gradients_finite, "guard")
    try:
        with (
            patch.object(torch.Tensor, "backward", parts.timed(torch.Tensor.backward, "backward")),
            patch.object(home, "gradients_finite", guard),
            patch.object(Clip, "__getitem__", parts.timed(Clip.__getitem__, "frame")),
        ):
            yield
    finally:
        for owner, name, kept in undo:
            object.__delattr__(owner, name)
            if kept is not None:
                object.__setattr__(owner, name, kept)


class Operations(TorchDispatchMode):
    """Counts what is dispatched; views apart, as they launch nothing."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter[str] = Counter()
        self.views = 0

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        if func.is_view:
            self.views += 1
        else:
            self.counts[str(func)] += 1
        return func(*args, **(kwargs or {}))


def run(trainer: Trainer, steps: int) -> None:
    trainer.train(until=trainer.step + steps)


def operations(trainer: Trainer, steps: int) -> dict[str, Any]:
    """Operations of a step, and launches on CUDA."""
    with Operations() as seen:
        run(trainer, steps)
    found: dict[str, Any] = {
        "operations": sum(seen.counts.values()) / steps,
        "views": seen.views / steps,
        "reads_by_the_host": seen.counts["aten._local_scalar_dense.default"] / steps,
        "most": {name: count / steps for name, count in seen.counts.most_common(12)},
    }
    if trainer.model.device.type == "cuda":
        activities = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
        with torch.profiler.profile(activities=activities) as profile:
            run(trainer, steps)
        runtime = Counter(e.name for e in profile.events() if e.name.startswith("cu"))
        found["cuda_calls"] = {
            name: count / steps for name, count in runtime.most_common(16) if count >= steps
        }
    return found


def measure(trainer: Trainer, steps: int) -> dict[str, Any]:
    device = trainer.model.device
    step_ms: list[float] = []
    spent: dict[bool, list[dict[str, float]]] = {False: [], True: []}
    block = max(1, steps // 15)  # waited and unwatched steps between the others
    done = 0
    while done < steps:
        count = min(block, steps - done)
        begun = clock(device)
        run(trainer, count)
        step_ms.append((clock(device) - begun) / count)
        done += count
        for wait in (False, True):
            parts = Parts(device, wait=wait)
            some = max(1, count // 4)
            with watched(trainer, parts):
                parts.switch("rest")
                run(trainer, some)
                parts.switch(None)
            spent[wait].append({name: value / some for name, value in parts.spent.items()})
    step = middle(step_ms)
    names = sorted({name for rows in spent.values() for row in rows for name in row})
    return {
        "step_ms": step,
        "blocks_ms": [round(x, 3) for x in step_ms],
        "minutes_of_30k_steps": round(LONG_RUN * step / 60_000, 2),
        "host_ms": {n: middle([row.get(n, 0.0) for row in spent[False]]) for n in names},
        "waited_ms": {n: middle([row.get(n, 0.0) for row in spent[True]]) for n in names},
    }


def measured(trainer: Trainer, steps: int) -> dict[str, Any]:
    """All figures of the trainer as it is, and whether graphs were replayed."""
    found = measure(trainer, steps) | operations(trainer, min(4, steps))
    found["graphs"] = trainer.gradients.used()
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_size(parser)
    parser.add_argument("--steps", type=int, default=300, help="that are timed unwatched")
    parser.add_argument("--warmup", type=int, default=20, help="steps before the first timed one")
    parser.add_argument("--frames", type=int, default=16, help="of the built-in clip")
    parser.add_argument("--graphs", choices=("auto", "on", "off", "both"), default="auto")
    parser.add_argument("--out", type=Path, help="keep the run, for frame_rate.py --run")
    options = parser.parse_args()
    size, splats = Size.parse(options.size), tuple(options.splats)
    rounds = 3 if options.graphs == "both" else 1
    total = rounds * (2 * options.steps + options.warmup + 100)
    settings = [
        f"train.steps={total}",
        f"train.graphs={'on' if options.graphs == 'both' else options.graphs}",
        # what only a whole run is long enough for: all parts take part from the first step
        *(f"train.warmup.{part}=0" for part in ("motion", "interaction", "poses", "cameras")),
        f"train.checkpoint_every={10 * total}",
        f"train.log_every={10 * total}",
        "train.preview_every=0",
        "model.scene.density.cap=" + str(splats[0]),
    ]
    with tempfile.TemporaryDirectory() as scratch:
        session = Session.open(
            clip_name(size.width, size.height, options.frames, splats),
            "hoigs",
            out=options.out or Path(scratch) / "run",
            overrides=spec_overrides(splats, [*settings, *options.overrides]),
            device=options.device,
            overwrite=True,
        )
        trainer = session.trainer
        for frame in session.clip:  # decoded and kept
            assert frame.image.shape[1] == size.width
        objective, without = trainer.objective, {}
        if options.graphs == "both":
            kept = objective.graphed_scene, trainer.gradients
            objective.graphed_scene = GraphedScene(trainer.model, "off", objective.weight_of)
            trainer.gradients = StepGradients(objective, "off")
            run(trainer, options.warmup)
            without = {"without_graphs": measured(trainer, options.steps)}
            # the model's part alone, as where a step has terms that no graph holds
            objective.graphed_scene = kept[0]
            run(trainer, options.warmup)
            without["graphs_of_the_scene"] = measured(trainer, options.steps)
            trainer.gradients = kept[1]
        run(trainer, options.warmup)
        report = {
            "machine": machine(trainer.model.device),
            "size": options.size,
            "splats": trainer.model.count(),
            "steps": options.steps,
            **measured(trainer, options.steps),
            **without,
            "splats_at_the_end": trainer.model.count(),
        }
        if options.out is not None:
            trainer.model.eval()
            trainer.checkpoint().save(session.run.checkpoints)
    print(f"{options.size}; {sum(report['splats'].values())} splats: {report['splats']}")
    print(f"{report['step_ms']:.2f} ms a step: 30,000 take {report['minutes_of_30k_steps']} min")
    for name in without:
        print(f"{report[name]['step_ms']:.2f} ms a step {name.replace('_', ' ')}")
    print(f"graphs: {report['graphs']['mode']}, {report['graphs']['why']}")
    print(f"{report['operations']:.0f} operations a step, {report['views']:.0f} views beside them")
    for name in report["host_ms"]:
        host, waited = report["host_ms"][name], report["waited_ms"][name]
        print(f"{name:12} host {host:8.2f} ms   waited for {waited:8.2f} ms")
    for name, count in report.get("cuda_calls", {}).items():
        print(f"{name:32}{count:8.1f}")
    write(report, options.json)


if __name__ == "__main__":
    main()
