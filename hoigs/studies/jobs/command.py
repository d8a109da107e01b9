"""A `hoigs` command as a job: `python -m hoigs.studies.jobs.command PARENT WORD …`.

It leads a process group of its own, which ends when the parent is killed.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time

PARENT_POLL_S = 0.25


def end_with(parent: int) -> None:
    """Watch `parent` from a thread; once it is gone, kill this process and all that it started."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(PARENT_POLL_S)
        os.killpg(0, signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()


if __name__ == "__main__":
    import runpy

    end_with(int(sys.argv[1]))
    sys.argv = ["hoigs", *sys.argv[2:]]
    runpy.run_module("hoigs", run_name="__main__")
