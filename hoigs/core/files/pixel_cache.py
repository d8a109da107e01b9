"""PixelCache: decoded frames within a budget of memory."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable

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

    def __getstate__(self) -> int:
        return self.budget // 2**20  # a copy decodes its own

    def __setstate__(self, cache_mb: int) -> None:
        self.__init__(cache_mb)  # type: ignore[misc]

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
