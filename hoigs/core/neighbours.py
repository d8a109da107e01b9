"""Between which of some times a time lies."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence


def neighbours(time: float, times: Sequence[float]) -> tuple[int, int, float]:
    """Indices of the entries of `times` about `time`, and the position between them in [0, 1].

    Held at the ends: before the first entry both are the first. An entry itself is both.

    Args:
        times: ascending, at least one.

    Raises:
        ValueError: `times` is empty.
    """
    if not times:
        raise ValueError("no times to lie between")
    after = bisect_left(times, time - 1e-6)  # float32 times must still hit their own entry
    high = min(after, len(times) - 1)
    low = high if times[high] <= time + 1e-6 else max(after - 1, 0)
    if low == high:
        return low, low, 0.0
    return low, high, (time - times[low]) / (times[high] - times[low])
