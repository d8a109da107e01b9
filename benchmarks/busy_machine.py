"""What a training costs beside other programs: CPU seconds alone, and with busy processes.

    python benchmarks/busy_machine.py --load 4 --json benchmarks/results/busy-machine.json

Each training runs in a process of its own: with threads that sleep while they wait, as hoigs sets
it beside busy programs; that spin shortly, as it sets it on an idle machine; that spin for
milliseconds, libgomp's default; and with one thread. CPU seconds are those of the training's own
process and threads, of its steps alone after the first tenth, in which kernels are loaded.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SPIN = "while True: pass"


def worker(clip: str, steps: int) -> None:
    """Train, and print the wall and CPU seconds of the steps."""
    from hoigs.training.session import Session

    with tempfile.TemporaryDirectory() as folder:
        settings = [
            f"train.steps={steps}",
            "train.preview_every=0",
            "train.checkpoint_every=100000",
        ]
        session = Session.open(Path(clip), "hoigs", out=Path(folder) / "run", overrides=settings)
        session.trainer.train(until=max(1, steps // 10))  # kernels are loaded
        before, began = resource.getrusage(resource.RUSAGE_SELF), time.perf_counter()
        session.trainer.train()
        after = resource.getrusage(resource.RUSAGE_SELF)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(json.dumps({"wall_s": time.perf_counter() - began, "cpu_s": cpu}))


def measured(clip: Path, steps: int, load: int, settings: dict[str, str]) -> dict[str, float]:
    """One training beside `load` busy processes."""
    environment = {
        k: v for k, v in os.environ.items() if not k.startswith(("OMP_", "GOMP_"))
    } | settings
    busy = [subprocess.Popen([sys.executable, "-c", SPIN]) for _ in range(load)]
    try:
        command = [sys.executable, __file__, "--worker", str(clip), "--steps", str(steps)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    finally:
        for process in busy:
            process.kill()
            process.wait()
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return {name: round(value, 2) for name, value in found.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--load", type=int, default=8, help="busy processes")
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker:
        worker(arguments.worker, arguments.steps)
        return
    from hoigs.core.machine.cpus import SHORT_SPIN
    from hoigs.plugins.bodies.anny import AnnyBody
    from hoigs.synthesis import SceneConfig, builtin_clip

    clip = builtin_clip(AnnyBody(), SceneConfig())
    rows = []
    ways = (
        {"OMP_WAIT_POLICY": "PASSIVE"},
        {"GOMP_SPINCOUNT": SHORT_SPIN},
        {},
        {"OMP_NUM_THREADS": "1"},
    )
    for settings in ways:
        for load in sorted({0, arguments.load}):
            average = round(os.getloadavg()[0], 1)
            times = measured(clip, arguments.steps, load, settings)
            row = {"settings": settings, "load average before": average, "added": load, **times}
            rows.append(row)
            print(row, flush=True)
    if arguments.json:
        record = {"cpus": os.cpu_count(), "steps": arguments.steps, "rows": rows}
        arguments.json.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
