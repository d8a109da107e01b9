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
LEASE_POLLS = 4  # looks at the parent for one at the lease, which may lie on a slow disk


def end_with(parent: int, lease: str = "") -> None:
    """Watch from a thread; kill this process and all that it started when they have to end.

    Args:
        parent: its number; it is gone once this process has another parent.
        lease: `FolderLock.lease` of the driver's lock. Where two looks find it gone or another's,
            another driver has taken the work over; one look may fall into a take-over that fails.
            It also ends with a driver on this machine, which on a cluster is not the parent: where
            the head is gone too, a Ray worker goes on for a minute.
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
