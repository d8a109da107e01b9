"""Cells of a benchmark in their own processes, with a JSON for each; resumable.

A benchmark calls `run_cells` in its parent, and in a child `write_cell`; the child is the same
script with `--cell NAME`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
POLL_S = 0.2
ALONE_S = 45.0


def write_cell(folder: Path, name: str, settings: dict[str, Any], result: dict[str, Any]) -> None:
    """One cell's JSON, whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    temporary = folder / f".{name}.{os.getpid()}.part"
    temporary.write_text(json.dumps({"settings": settings, **result}, indent=1))
    temporary.replace(folder / f"{name}.json")


def read_cell(folder: Path, name: str, settings: dict[str, Any]) -> dict[str, Any] | None:
    """A cell that is done under these settings; one of other settings counts as not done."""
    path = folder / f"{name}.json"
    if not path.is_file():
        return None
    found: dict[str, Any] = json.loads(path.read_text())
    return found if found["settings"] == json.loads(json.dumps(settings)) else None


def run_cells(
    names: Sequence[str],
    folder: Path,
    settings: dict[str, Any],
    arguments: Sequence[str],
    *,
    jobs: int,
    threads: int,
    minutes: float | None,
) -> list[str]:
    """Run what is not done, `jobs` at a time.

    The first cell that is not done runs alone for `ALONE_S` at most: kernels are compiled once, not
    by all.

    Args:
        arguments: of each child, beside `--cell NAME`. minutes: after which what still runs is
            ended; another call goes on.

    Returns:
        Names that are not done, with what their logs end with in FOLDER/NAME.log.
    """
    folder.mkdir(parents=True, exist_ok=True)
    deadline = None if minutes is None else time.monotonic() + 60 * minutes
    waiting = [name for name in names if read_cell(folder, name, settings) is None]
    print(f"{len(names) - len(waiting)} of {len(names)} done before", flush=True)
    running: dict[str, subprocess.Popen[bytes]] = {}
    begun: dict[str, float] = {}
    warmed = False
    try:
        while waiting or running:
            if deadline is not None and time.monotonic() > deadline:
                print(f"time is up: {len(waiting) + len(running)} left", flush=True)
                break
            while waiting and len(running) < (jobs if warmed else 1):
                name = waiting.pop(0)
                running[name], begun[name] = _start(name, folder, arguments, threads), time.time()
                if not warmed:
                    break
            time.sleep(POLL_S)
            warmed = warmed or any(time.time() - start > ALONE_S for start in begun.values())
            for name in [n for n, process in running.items() if process.poll() is not None]:
                code = running.pop(name).returncode
                warmed = True
                word = "done" if code == 0 else f"FAILED, see {folder / name}.log"
                print(f"{name}: {word}, {time.time() - begun[name]:.0f} s", flush=True)
    finally:
        for process in running.values():
            process.terminate()
        for process in running.values():
            process.wait()
    return [name for name in names if read_cell(folder, name, settings) is None]


def _start(
    name: str, folder: Path, arguments: Sequence[str], threads: int
) -> subprocess.Popen[bytes]:
    environment = os.environ | dict.fromkeys(THREADS, str(threads))
    command = [sys.executable, sys.argv[0], "--cell", name, *arguments]
    with (folder / f"{name}.log").open("wb") as log:
        return subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=environment)
