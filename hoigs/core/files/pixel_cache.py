"""PixelCache: decoded frames within a budget of memory."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any

from torch import Tensor


class PixelCache:
    """The last used tensors, up to a budget; the least recently used go first.

    Safe to use from several threads: loading happens outside the lock.

    Args:
        cache_mb: MiB; 0 keeps nothing.

    Attributes:
        cached_bytes: kept now.
    """

    def __init__(self, cache_mb: int) -> None:
        self.budget = cache_mb * 2**20
        self.cached_bytes = 0
        self._kept: OrderedDict[Hashable, Tensor] = OrderedDict()
        self._lock = threading.Lock()

    def __getstate__(self) -> dict[str, Any]:
        """Copies and pickles have the budget only: pixels are decoded again where they are read."""
        return {"budget": self.budget}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(0)  # type: ignore[misc]  # makes an empty cache and a lock
        self.budget = state["budget"]

    def get(self, key: Hashable, load: Callable[[], Tensor]) -> Tensor:
        """What is kept under `key`, or what `load` returns."""
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key]
        value = load()
        size = value.element_size() * value.numel()
        with self._lock:
            if key not in self._kept and size <= self.budget:
                self._kept[key] = value
                self.cached_bytes += size
            while self.cached_bytes > self.budget:
                _, old = self._kept.popitem(last=False)
                self.cached_bytes -= old.element_size() * old.numel()
        return value
