"""How many pairs of splat and tile to make room for, without asking the device."""

from __future__ import annotations

import torch

HEADROOM = 1.5  # room for so many times the most pairs seen
STEP = 65536  # pairs; room grows by whole steps, so that memory is used again
PINNED: list[PairRoom] = []  # graphs write into the memory of these as long as they live


class PairRoom:
    """Room for pairs on one device, growing with what its renders needed.

    A kernel of each render notes the most pairs so far in the host's memory; later renders read
    that without waiting, whatever the device has come to. Until as many Gaussians and tiles have
    been seen as a render has, its own number is waited for (`measured`).

    Attributes:
        seen: [1] int64 on the device, the most pairs of any render.
        told: [1] int64 in pinned host memory, which the device writes.
    """

    def __init__(self, device: torch.device) -> None:
        self.seen = torch.zeros(1, dtype=torch.int64, device=device)
        self.told = torch.zeros(1, dtype=torch.int64).pin_memory()
        self._told = self.told.numpy()
        self._known = (0, 0)
        self._room = STEP

    def capacity(self, count: int, tiles: int) -> int:
        """Pairs to make room for, at least `count`; 0 when they must be measured first."""
        if count > self._known[0] or tiles > self._known[1]:
            return 0
        return max(self._grown(int(self._told[0])), count)

    def measured(self, count: int, tiles: int, pairs: int) -> int:
        """Likewise, given how many pairs a render with so many Gaussians and tiles has."""
        known = self._known
        self._known = (max(known[0], count), max(known[1], tiles))
        return max(self._grown(pairs), count)

    def outgrown(self, capacity: int) -> bool:
        """Whether some render had more pairs than this."""
        return int(self._told[0]) > capacity

    def keep_for_graphs(self) -> None:
        """Never free the memory that kernels note into."""
        if self not in PINNED:
            PINNED.append(self)

    def _grown(self, pairs: int) -> int:
        """Room for `pairs` and more to come."""
        if pairs * 1.1 > self._room:
            self._room = min(-(-int(pairs * HEADROOM) // STEP) * STEP, 2**31 - 1)
        return self._room
