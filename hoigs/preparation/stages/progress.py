"""Named stages of a long job: their times, and one progress number for all."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import TypeVar

from hoigs.core.progress import Progress, no_progress

T = TypeVar("T")


class Stages:
    """Times the stages and reports the progress of the whole.

    Args:
        weights: stage name to its share of the time, roughly; in order.
        progress: called with 0..1 and the stage's name; None: not called.
    """

    def __init__(self, weights: Mapping[str, float], progress: Progress | None = None) -> None:
        total = sum(weights.values())
        self._share = {name: weight / total for name, weight in weights.items()}
        self._progress = progress or no_progress
        self._before = 0.0
        self._name = ""
        self._start = 0.0
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """One of the named stages."""
        self._name = name
        self._progress(self._before, name)
        self._start = time.perf_counter()
        yield
        self.seconds[name] = self.elapsed()
        self._before += self._share[name]
        self._progress(self._before, name)

    def elapsed(self) -> float:
        """Seconds since the current stage began."""
        return round(time.perf_counter() - self._start, 2)

    def advance(self, fraction: float) -> None:
        """`fraction` 0..1 of the current stage is done."""
        self._progress(self._before + fraction * self._share[self._name], self._name)

    def track(self, items: Iterable[T], count: int) -> Iterator[T]:
        """`items`, advancing by one of `count` with each."""
        for done, item in enumerate(items, start=1):
            yield item
            self.advance(done / count)
