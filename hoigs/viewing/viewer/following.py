"""FollowedRun: a run read again whenever training has written a newer checkpoint."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from pathlib import Path

from hoigs.core.errors import HoigsError
from hoigs.core.system.folder_lock import FolderLock
from hoigs.runs.checkpoint import has_checkpoint, latest_checkpoint
from hoigs.runs.loaded_run import LoadedRun
from hoigs.runs.run_folder import RunFolder

RECENT_S = 120.0  # a run whose metrics changed since is taken to be in training


class FollowedRun:
    """A run folder and how to read it. `poll` reads in a thread, so that drawing goes on.

    Args:
        open_it: reads the run.
    """

    def __init__(self, path: Path, open_it: Callable[[], LoadedRun]) -> None:
        self.path, self._open = path, open_it
        self.loaded = open_it()
        self._newest = latest_checkpoint(RunFolder(path).checkpoints)
        self._thread: threading.Thread | None = None
        self._result: LoadedRun | None = None

    def poll(self) -> LoadedRun | None:
        """The run at its newest checkpoint, once after each; otherwise None."""
        if self._result is not None:
            self.loaded, self._result = self._result, None
            return self.loaded
        if self._thread is not None and self._thread.is_alive():
            return None
        checkpoints = RunFolder(self.path).checkpoints
        if has_checkpoint(checkpoints):
            newest = latest_checkpoint(checkpoints)
            if newest != self._newest:
                self._newest = newest
                self._thread = threading.Thread(target=self._read, daemon=True)
                self._thread.start()
        return None

    def _read(self) -> None:
        try:
            try:
                self._result = self.loaded.newer(self.path)
            except HoigsError:  # for example removed meanwhile, or of another spec
                self._result = self._open()
        except HoigsError as error:  # for example replaced by another run meanwhile
            print(f"{self.path}: the newer checkpoint cannot be read: {error}", flush=True)


def wait_for_checkpoint(path: Path, report: Callable[[str], None]) -> None:
    """Return once the run has a checkpoint; at once if it has one, or is not in training.

    Args:
        report: receives a line before waiting.
    """
    run = RunFolder(path)
    run.require()
    told = False
    while not has_checkpoint(run.checkpoints) and in_training(run):
        if not told:
            report(
                f"{path} has no checkpoint yet and is at step {steps_done(run)}: waiting for the "
                "first one (train.checkpoint_every)"
            )
            told = True
        time.sleep(0.5)


def in_training(run: RunFolder) -> bool:
    """Whether the run's metrics, its spec or the lock of its training were written lately."""
    lock = FolderLock(run.path, "").path
    files = [p for p in (run.metrics, run.spec, lock) if p.exists()]
    return any(time.time() - p.stat().st_mtime < RECENT_S for p in files)


def steps_done(run: RunFolder) -> int:
    """The step of the last whole line of the metrics; 0 without any."""
    lines = run.metrics.read_text().splitlines() if run.metrics.exists() else []
    for line in reversed(lines):
        try:
            return int(json.loads(line)["step"])
        except (ValueError, KeyError):
            continue
    return 0
