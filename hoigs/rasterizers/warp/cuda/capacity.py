"""For how many tile intersections to allocate memory, without waiting for the device."""

from __future__ import annotations

import torch

HEADROOM = 1.5  # memory for so many times the largest number seen
STEP = 65536  # intersections; capacity grows by whole steps, so that memory is reused
PINNED: list[IntersectionCapacity] = []  # graphs write into their memory as long as they live


class IntersectionCapacity:
    """Intersections for which renders on one device allocate memory; it grows with their number.

    A kernel of each render writes the largest number so far into the host's memory. Later renders
    read it without waiting, whatever the device has finished by then. A render with more Gaussians
    or more tiles than all before it counts its own intersections first (`counted`).

    Attributes:
        largest: [1] int64 on the device, the largest number of any render.
        largest_on_host: [1] int64 in pinned host memory, written by the device.
    """

    def __init__(self, device: torch.device) -> None:
        self.largest = torch.zeros(1, dtype=torch.int64, device=device)
        self.largest_on_host = torch.zeros(1, dtype=torch.int64).pin_memory()
        self._largest = self.largest_on_host.numpy()
        self._counted = (0, 0)
        self._capacity = STEP

    def of(self, count: int, tiles: int) -> int:
        """Intersections to allocate for, at least `count`; 0 where they must be counted first."""
        if count > self._counted[0] or tiles > self._counted[1]:
            return 0
        return max(self._grown(int(self._largest[0])), count)

    def counted(self, count: int, tiles: int, intersections: int) -> int:
        """Likewise, given how many a render with so many Gaussians and tiles has."""
        known = self._counted
        self._counted = (max(known[0], count), max(known[1], tiles))
        return max(self._grown(intersections), count)

    def exceeded(self, capacity: int) -> bool:
        """Whether some render had more intersections than this."""
        return int(self._largest[0]) > capacity

    def keep_for_graphs(self) -> None:
        """Never free the memory that captured kernels write into."""
        if self not in PINNED:
            PINNED.append(self)

    def _grown(self, intersections: int) -> int:
        if intersections * 1.1 > self._capacity:
            steps = -(-int(intersections * HEADROOM) // STEP)
            self._capacity = min(steps * STEP, 2**31 - 1)
        return self._capacity
