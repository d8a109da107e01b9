"""Preparations that run in the background: started, followed, stopped."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hoigs.core.errors import HoigsError
from hoigs.core.system.environments import PYTHON


class Job:
    """One preparation in a process of its own, with all that it starts.

    Args:
        settings: of `worker.run`. finished: called when it has ended well.
    """

    def __init__(self, settings: dict[str, Any], finished: Callable[[], None]) -> None:
        self.whole = bool(settings["whole"])
        self._finished = finished
        self._lock = threading.Lock()
        self._state: dict[str, Any] = {
            "whole": self.whole, "state": "running", "done": 0.0, "text": "starting",
        }  # fmt: skip
        self._stopped = False
        command = [*PYTHON, "-m", "hoigs.viewing.annotate.worker", json.dumps(settings)]
        self._process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            text=True, start_new_session=True,
        )  # fmt: skip
        self._last: deque[str] = deque(maxlen=12)  # lines of stderr
        self._errors = threading.Thread(target=self._read_errors, daemon=True)
        self._errors.start()
        self._thread = threading.Thread(target=self._follow, daemon=True)
        self._thread.start()

    @property
    def running(self) -> bool:
        with self._lock:
            return self._state["state"] == "running"

    def state(self) -> dict[str, Any]:
        """For the page: state ("running", "finished", "failed", "stopped"), done 0..1, text, plan,
        error, and rows of the report."""
        with self._lock:
            return dict(self._state)

    def stop(self) -> None:
        """Ends it and what it started; what was done before is kept by the preparation itself."""
        self._stopped = True
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGTERM)
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, signal.SIGKILL)
        self._thread.join(5)

    def _read_errors(self) -> None:
        assert self._process.stderr is not None
        for line in self._process.stderr:
            self._last.append(line.rstrip())

    def _follow(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            try:
                event = json.loads(line)
            except ValueError:
                continue  # what a library prints
            if event.pop("finished", False):
                self._finished()
                event = {"state": "finished", "done": 1.0}
            elif "error" in event:
                event["state"] = "failed"
            self._update(event)
        code = self._process.wait()
        self._errors.join(5)
        if self._stopped:
            self._update({"state": "stopped"})
        elif self.running:
            what = f"the preparation ended unexpectedly (exit status {code}):"
            self._update({"state": "failed", "error": "\n".join([what, *self._last]).strip()})

    def _update(self, event: dict[str, Any]) -> None:
        with self._lock:
            if self._state["state"] == "running" or self._stopped:
                self._state.update(event)


class Jobs:
    """At most one preparation at a time.

    Args:
        video, out: of the preparations; `options`: further ones, as JSON.
    """

    def __init__(self, video: Path, options: dict[str, Any]) -> None:
        self.video, self.options = video, options
        self._job: Job | None = None
        self._lock = threading.Lock()

    def start(
        self, out: Path, *, whole: bool, yes: bool, replace: bool, finished: Callable[[], None]
    ) -> None:
        """Starts one.

        Args:
            whole: a clip, or masks alone. yes: install what is needed. replace: an older clip.
            finished: called when it has ended well.

        Raises:
            HoigsError: one is running.
        """
        with self._lock:
            if self._job is not None and self._job.running:
                raise HoigsError("a preparation is running: stop it, or wait for its end")
            settings = {
                "video": str(self.video), "out": str(out), "options": self.options,
                "whole": whole, "yes": yes, "replace": replace,
            }  # fmt: skip
            self._job = Job(settings, finished)

    def state(self) -> dict[str, Any]:
        """Of the last one; empty without one."""
        return {} if self._job is None else self._job.state()

    def stop(self) -> None:
        with self._lock:
            if self._job is not None and self._job.running:
                self._job.stop()
