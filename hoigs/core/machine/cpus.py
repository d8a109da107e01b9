"""The processors that this process may use."""

from __future__ import annotations

import math
import os
from pathlib import Path

CGROUP = Path("/sys/fs/cgroup")


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
