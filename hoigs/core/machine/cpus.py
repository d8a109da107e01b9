"""The processors that this process may use, and how its threads wait for each other."""

from __future__ import annotations

import math
import os
import time
from pathlib import Path

CGROUP = Path("/sys/fs/cgroup")
LOAD = Path("/proc/loadavg")

SHORT_SPIN = "30000"
"""Turns of libgomp's waiting loop before a thread sleeps; a tenth of libgomp's own default."""

SAMPLES = 5  # of the number of running threads, whose middle one counts


def available_cpus() -> int:
    """Processors by affinity and by the quota of the container, at least 1."""
    try:
        count = len(os.sched_getaffinity(0))
    except AttributeError:  # not on macOS and Windows
        count = os.cpu_count() or 1
    quota = _quota(CGROUP)
    return max(1, count if quota is None else min(count, math.ceil(quota)))


def _quota(root: Path) -> float | None:
    """Processors that the control group may use at a time; None without a limit."""
    try:
        limit, period = (root / "cpu.max").read_text().split()
        return None if limit == "max" else int(limit) / int(period)
    except (OSError, ValueError):
        pass
    try:  # version 1 of control groups
        limit_us = int((root / "cpu/cpu.cfs_quota_us").read_text())
        return (
            limit_us / int((root / "cpu/cpu.cfs_period_us").read_text()) if limit_us > 0 else None
        )
    except (OSError, ValueError, ZeroDivisionError):
        return None


def share_processors() -> None:
    """Settings of OpenMP for what the machine does at this moment; those already set stay.

    Effective only before torch is imported. By default libgomp's threads spin for milliseconds
    while they wait for each other. Beside other programs what they wait for may not even be
    running, so there they sleep. On an idle machine waking them costs more than a short spin.
    """
    os.environ.setdefault("OMP_NUM_THREADS", str(available_cpus()))
    if {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"} & os.environ.keys():
        return
    if others_run():
        os.environ["OMP_WAIT_POLICY"] = "PASSIVE"
    else:
        os.environ["GOMP_SPINCOUNT"] = SHORT_SPIN


def others_run() -> bool:
    """Whether other programs keep half of the processors busy; True where that is unknown."""
    counts = []
    try:
        for _ in range(SAMPLES):
            running, _slash, _all = LOAD.read_text().split()[3].partition("/")
            counts.append(int(running) - 1)  # the reader itself is running
            time.sleep(0.002)
    except (OSError, ValueError, IndexError):
        return True
    return sorted(counts)[SAMPLES // 2] >= max(1, (os.cpu_count() or 1) // 2)
