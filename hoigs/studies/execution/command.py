"""A Python module as a job: `python -m hoigs.studies.execution.command PARENT LEASE MODULE WORD …`.

It leads a process group of its own, which ends when the parent or the driver is killed, or the
lease is another's.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from pathlib import Path

from hoigs.core.system.folder_lock import is_held

PARENT_POLL_S = 0.25
LEASE_POLLS = 4  # the lease, perhaps on a slow disk, is read at every fourth poll of the parent


def end_with(parent: int, lease: str = "") -> None:
    """Watch from a thread; kill this process and all that it started when they have to end.

    Args:
        parent: its number; it is gone once this process has another parent.
        lease: `FolderLock.lease` of the driver's lock. If it is absent or another driver's in two
            polls, that driver has taken over the work (in one poll, the take-over may still fail).
            On a cluster, where the driver is not the parent, this also ends the process with the
            driver; a Ray worker would continue for a minute without the cluster's head.
    """
    path, _, token = lease.rpartition(":")

    def watch() -> None:
        looks = lost = 0
        while os.getppid() == parent and lost < 2:
            time.sleep(PARENT_POLL_S)
            looks += 1
            if path and (lost or looks % LEASE_POLLS == 0):
                lost = 0 if is_held(Path(path), token) else lost + 1
        if lost:
            why = "the driver has ended, or another one has taken this work over"
            print(f"error: {why}", file=sys.stderr, flush=True)
        os.killpg(0, signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()


if __name__ == "__main__":
    import runpy

    end_with(int(sys.argv[1]), sys.argv[2])
    sys.argv = sys.argv[3:]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=False)
