"""What a training costs beside other programs: CPU seconds alone, and with busy processes.

    python benchmarks/busy_machine.py --steps 30 --json benchmarks/results/busy-machine.json

Each training runs in a process of its own, in one of three ways: as the commands of hoigs do, with
libgomp's default, whose waiting threads spin for milliseconds, and with one thread. The busy
processes begin after the first tenth of the steps, in which kernels are loaded: a command cannot
know of them as it starts. CPU seconds are those of the training's own process and threads, of the
other steps.
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
WAYS: dict[str, dict[str, str]] = {
    "hoigs": {},
    "libgomp's default": {},
    "one thread": {"OMP_NUM_THREADS": "1"},
}


def worker(clip: str, steps: int, as_commands: bool) -> None:
    """Train, and print the wall and CPU seconds of the steps."""
    from hoigs.core.system.threads import share_processors, short_waits_when_busy

    if as_commands:
        share_processors()
    from hoigs.training.session import Session

    with tempfile.TemporaryDirectory() as folder, short_waits_when_busy():
        settings = [
            f"train.steps={steps}",
            "train.preview_every=0",
            "train.checkpoint_every=100000",
        ]
        session = Session.open(Path(clip), "hoigs", out=Path(folder) / "run", overrides=settings)
        session.trainer.train(until=max(1, steps // 10))  # kernels are loaded
        print("ready", flush=True)
        input()
        before, began = resource.getrusage(resource.RUSAGE_SELF), time.perf_counter()
        session.trainer.train()
        after = resource.getrusage(resource.RUSAGE_SELF)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(json.dumps({"wall_s": time.perf_counter() - began, "cpu_s": cpu}))


def measured(clip: Path, steps: int, load: int, way: str) -> dict[str, float]:
    """One training beside `load` busy processes."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("OMP_", "GOMP_"))}
    command = [sys.executable, __file__, "--worker", str(clip), "--steps", str(steps)]
    training = subprocess.Popen(
        [*command, "--ways", way], env=environment | WAYS[way], stdin=subprocess.PIPE,
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert training.stdout is not None
    if training.stdout.readline() != "ready\n":
        raise SystemExit(f"{way}: the training failed")
    busy = [subprocess.Popen([sys.executable, "-c", SPIN]) for _ in range(load)]
    try:
        printed, _ = training.communicate("\n")
    finally:
        for process in busy:
            process.kill()
            process.wait()
    found: dict[str, float] = json.loads(printed.splitlines()[-1])
    return {name: round(value, 2) for name, value in found.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--load", type=int, default=8, help="busy processes")
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--ways", default=",".join(WAYS))
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker:
        worker(arguments.worker, arguments.steps, arguments.ways == "hoigs")
        return
    from hoigs.plugins.bodies.anny import AnnyBody
    from hoigs.synthesis import SceneConfig, builtin_clip

    clip = builtin_clip(AnnyBody(), SceneConfig())
    rows = []
    for way in arguments.ways.split(","):
        for load in sorted({0, arguments.load}):
            average = round(os.getloadavg()[0], 1)
            times = measured(clip, arguments.steps, load, way)
            row = {"way": way, "load average before": average, "added": load, **times}
            rows.append(row)
            print(row, flush=True)
    if arguments.json:
        record = {"cpus": os.cpu_count(), "steps": arguments.steps, "rows": rows}
        arguments.json.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
