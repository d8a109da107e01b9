"""Memory, handles, time a step and checkpoints over a very long training of a tiny model.

    python benchmarks/long_run.py --steps 100000 --json benchmarks/results/long-run.json
    python benchmarks/long_run.py --steps 60 --width 16         # what the tests run

The trainer is `hoigs train`'s own with spec `hoigs`: density control and every rule of the spec to
the end, checkpoints of which the last ones are kept, and a preview drawn from the model now and
then, as a viewer does. From a fifth of the steps on the spec's interaction is at work
(`train.warmup.interaction`), which costs time; so the steps between a quarter and a third are
compared with the last tenth of those made. Flat is: memory within 5 % and 64 MiB, handles equal,
steps within 25 %, and no more checkpoints than `train.keep_checkpoints`. Exit code 1 if anything is
not flat.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

KEPT = 3
MARGIN = 64 * 2**20


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--width", type=int, default=32, help="of the square frames")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--minutes", type=float, help="end after this time, and say at which step")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        record = measured(arguments, Path(folder))
    print(json.dumps({k: v for k, v in record.items() if k != "rows"}, indent=1))
    if arguments.json:
        arguments.json.write_text(json.dumps(record, indent=1) + "\n")
    return int(not all(record["flat"].values()))


def measured(arguments: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Trains, with a row of readings a hundred times."""
    import hoigs

    steps, out, rows = arguments.steps, folder / "run", []
    # on the CPU what else runs does not count; on CUDA the processor waits
    clock = time.process_time if arguments.device == "cpu" else time.perf_counter
    began, started_at = clock(), time.perf_counter()
    session = None

    def started(new: Any) -> None:
        nonlocal session
        session = new

    def read(step: Any) -> None:
        clip, model = session.trainer.clip, session.trainer.model
        moment, camera = (x.to(model.device) for x in (clip[0].moment, clip.cameras[0]))
        model.render(moment, camera)  # a preview
        kept = [p for p in (out / "checkpoints").iterdir() if p.suffix == ".safetensors"]
        rows.append({
            "step": step.step, "seconds": clock() - began, "memory": resident(),
            "handles": len(list(Path("/proc/self/fd").iterdir())), "checkpoints": len(kept),
            "gaussians": sum(step.counts.values()), "loss": step.loss,
        })  # fmt: skip
        if arguments.minutes and time.perf_counter() - started_at > 60 * arguments.minutes:
            raise KeyboardInterrupt

    every = max(1, steps // 100)
    settings = {
        "train.steps": steps, "train.log_every": every, "train.checkpoint_every": 2 * every,
        "train.keep_checkpoints": KEPT, "train.preview_every": 10 * every,
        "model.scene.points": 300, "model.scene.density.cap": 600, "model.human.points": 200,
        "model.object.points": 100, "model.human.deformation.resolution": 16,
    }  # fmt: skip
    with contextlib.suppress(KeyboardInterrupt):
        hoigs.train(
            f"builtin:lift-and-swing?width={arguments.width}", "hoigs", out=out, evaluate=False,
            overrides=[f"{k}={v}" for k, v in settings.items()], device=arguments.device,
            on_start=started, on_step=read,
        )  # fmt: skip
    return judged(rows, steps) | {"device": arguments.device, "rows": rows}


def resident() -> int:
    """Bytes of memory that this process holds."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def judged(rows: list[dict[str, float]], steps: int) -> dict[str, Any]:
    """Rows between a quarter and a third of the steps against the last ones, and what is flat."""
    first = [row for row in rows if steps / 4 <= row["step"] <= steps / 3]
    last = rows[-max(2, len(rows) // 10) :]

    def rate(some: list[dict[str, float]]) -> float:
        each = [(b["seconds"] - a["seconds"]) / (b["step"] - a["step"]) for a, b in pairwise(some)]
        return 1000 * median(each)

    def middle(some: list[dict[str, float]], key: str) -> float:
        return median(row[key] for row in some)

    memory = middle(first, "memory"), middle(last, "memory")
    handles = middle(first, "handles"), middle(last, "handles")
    times = rate(first), rate(last)
    most = max(row["checkpoints"] for row in rows)
    return {
        "steps": f"{last[-1]['step']:.0f} of {steps}",
        "memory_mib": [round(v / 2**20, 1) for v in memory],
        "handles": handles,
        "step_ms": [round(v, 2) for v in times],
        "gaussians": [middle(first, "gaussians"), middle(last, "gaussians")],
        "checkpoints": most,
        "flat": {
            "memory": memory[1] < 1.05 * memory[0] + MARGIN,
            "handles": handles[1] <= handles[0],
            "step": times[1] < 1.25 * times[0],
            "checkpoints": most <= KEPT,
        },
    }


if __name__ == "__main__":
    sys.exit(main())
