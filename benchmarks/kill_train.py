"""SIGKILL `hoigs train` at random moments, resume it each time, and see that nothing is lost.

    python benchmarks/kill_train.py
    python benchmarks/kill_train.py --kills 10 --json killed.json

An unbroken run comes first. Then the same run is started again and again, resumed if it
exists, and killed: every other time at a random moment between its start and the time
that the unbroken run took, and every other time within 5 ms of the appearance of a temporary file,
that is while it writes. After each kill all that stands in the run folder under its final name is
read. A run that completes is compared with the unbroken one, bit for bit, and started anew
until there have been enough kills. On one thread, as sums of several have no fixed order.

Exit code 1 when anything could not be read, could not be resumed, or differs.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

POLL_S = 0.001


@dataclass
class Kills:
    """What happened.

    Attributes:
        aimed: kills while a temporary file was there, by its name.
        before_run: kills before the run folder was there. before_checkpoint: before its first one.
        finished: runs that got to their end. faults: what was wrong, empty when all is well.
    """

    kills: int = 0
    aimed: dict[str, int] = field(default_factory=dict)
    before_run: int = 0
    before_checkpoint: int = 0
    resumed_from: list[int] = field(default_factory=list)
    finished: int = 0
    faults: list[str] = field(default_factory=list)


def hammer(
    command: Sequence[str], run: Path, whole: Path, *, kills: int, duration: float, seed: int = 0
) -> Kills:
    """Kill and resume until there have been `kills` kills and the last run has ended.

    Args:
        command: makes the run; "--resume" is appended wherever the run is there already.
        run: its folder. whole: of the unbroken run. duration: seconds that one took.
    """
    chance, record = random.Random(seed), Kills()
    while True:
        resume = (run / "spec.yaml").exists()
        process = subprocess.Popen(
            [*command, *(["--resume"] if resume else [])],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )
        if record.kills < kills:
            aim = record.kills % 2 == 1
            seen = _wait(process, run, chance, duration, aim)
            if process.poll() is None:
                process.send_signal(signal.SIGKILL)
                process.wait()
                record.kills += 1
                if seen:
                    record.aimed[seen] = record.aimed.get(seen, 0) + 1
                _look(run, record)
                continue
        _, said = process.communicate()
        if process.returncode != 0:
            record.faults.append(f"exit code {process.returncode}: {said.decode()[-2000:]}")
            return record
        record.finished += 1
        record.faults += differences(run, whole)
        if record.kills >= kills or record.faults:
            return record
        shutil.rmtree(run)


def _wait(
    process: subprocess.Popen[bytes], run: Path, chance: random.Random, duration: float, aim: bool
) -> str | None:
    """Until the moment to kill, or the end of the process; the temporary file aimed at."""
    until = time.perf_counter() + chance.uniform(0, duration)
    skip = chance.randrange(12)  # so that not only the first file of a process is hit
    found: set[str] = set()
    while process.poll() is None:
        if aim:
            parts = {path.name for path in _temporaries(run)}
            if parts - found:
                found |= parts
                skip -= 1
                if skip < 0:
                    time.sleep(chance.uniform(0, 0.005))
                    return _kind(sorted(parts)[0])
        elif time.perf_counter() > until:
            return None
        time.sleep(POLL_S)
    return None


def _temporaries(run: Path) -> Iterator[Path]:
    yield from run.parent.glob(f".{run.name}.*")
    yield from run.glob("**/*.part")


def _kind(name: str) -> str:
    return "run folder" if name.startswith(".") and name.count(".") > 2 else Path(name).suffixes[0]


def _look(run: Path, record: Kills) -> None:
    """Read all that has its final name, as a resumed run would."""
    from hoigs.core.errors import HoigsError
    from hoigs.core.spec.schema import Spec
    from hoigs.runs.checkpoint import has_checkpoint, latest_checkpoint, load_checkpoint

    if not run.exists():
        record.before_run += 1
        return
    try:
        Spec.load(run / "spec.yaml")
        json.loads((run / "provenance.json").read_text())
        if not has_checkpoint(run / "checkpoints"):
            record.before_checkpoint += 1
            return
        checkpoint = load_checkpoint(latest_checkpoint(run / "checkpoints"))
        record.resumed_from.append(int(checkpoint.meta["step"]))
    except (HoigsError, ValueError, OSError) as error:
        record.faults.append(f"after kill {record.kills}: {error}")


def differences(run: Path, whole: Path) -> list[str]:
    """In what a run that was broken differs from the unbroken one: weights, moments, metrics."""
    from hoigs.runs.checkpoint import latest_checkpoint, load_checkpoint

    ours, theirs = (load_checkpoint(latest_checkpoint(r / "checkpoints")) for r in (run, whole))
    if ours.meta["step"] != theirs.meta["step"]:
        return [f"ended at step {ours.meta['step']}, not {theirs.meta['step']}"]
    faults = [f"{key} differs" for key in theirs.tensors if not _equal(ours, theirs, key)]
    faults += [f"{key} is new" for key in ours.tensors.keys() - theirs.tensors.keys()]
    losses = [
        [(r["step"], r["loss"]) for r in map(json.loads, (f / "metrics.jsonl").open())]
        for f in (run, whole)
    ]
    return faults + (["metrics.jsonl differs"] if losses[0] != losses[1] else [])


def _equal(ours: object, theirs: object, key: str) -> bool:
    from hoigs.runs.checkpoint import Checkpoint

    assert isinstance(ours, Checkpoint) and isinstance(theirs, Checkpoint)
    return key in ours.tensors and ours.tensors[key].equal(theirs.tensors[key])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--spec", default="hoigs")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    clip = (
        "builtin:lift-and-swing?width=64&frames=12&fps=3&edge_samples=4&held_out_views=2"
        "&test_frames=3&scene_points=2000&object_points=300"
    )
    folder = Path(tempfile.mkdtemp(prefix="kill-train-"))
    command = [
        sys.executable, "-c", "from hoigs.cli.main import main; main()", "train", clip,
        "--spec", options.spec, "--device", "cpu", "--no-eval",
        "--set", f"train.steps={options.steps}", "--set", "train.checkpoint_every=2",
        "--set", "train.log_every=1", "--set", "train.preview_every=0",
    ]  # fmt: skip
    try:
        environment = os.environ | {"OMP_NUM_THREADS": "1"}
        for _ in range(2):  # the first fills the caches of clips and kernels
            shutil.rmtree(folder / "whole", ignore_errors=True)
            started = time.perf_counter()
            subprocess.run(
                [*command, "--out", str(folder / "whole")],
                check=True, env=environment, stdout=subprocess.DEVNULL,
            )  # fmt: skip
            duration = time.perf_counter() - started
        run = folder / "killed"
        record = hammer(
            [*command, "--out", str(run)], run, folder / "whole",
            kills=options.kills, duration=duration, seed=options.seed,
        )  # fmt: skip
    finally:
        shutil.rmtree(folder)
    result = {"unbroken_s": round(duration, 2), "steps": options.steps, **asdict(record)}
    print(json.dumps(result, indent=1))
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n")
    return 1 if record.faults else 0


if __name__ == "__main__":
    sys.exit(main())
