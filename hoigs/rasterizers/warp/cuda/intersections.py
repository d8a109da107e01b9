"""Tile intersections on CUDA, found without waiting for the device.

No kernel's size depends on how many intersections there are:

    count    a thread a Gaussian: how many tiles its ellipse touches, and one more for each of them
    plan     one block: running sums over tiles and Gaussians, and whether the intersections fit
    place    a thread a Gaussian: its keys (depth, partial) into its tiles, in any order

`blend` sorts them by depth, as far as it draws. Partials are numbered by Gaussian, so that ties are
broken by index.

`Scratch.counts` is zero before and after, since `place` counts down where `count` counted up.

Where the intersections exceed the allocated memory, `plan` sorts all drawn Gaussians into one list
that all tiles share; each tile then skips those whose box misses it. The picture is the same, but
takes longer, and its gradients are summed in no fixed order. The length of that list stands behind
the offsets, -1 where each tile has its own.
"""

from __future__ import annotations

import threading

import torch
from torch import Tensor

from hoigs.core.errors import RenderError
from hoigs.core.fast.cuda_launch import CudaStream, CudaStreams
from hoigs.rasterizers.warp.arguments import Projected
from hoigs.rasterizers.warp.blend.pixel_source import TILE_HEIGHT
from hoigs.rasterizers.warp.frame import INT32, Settings, TileIntersections, check_addressable
from hoigs.rasterizers.warp.intersect import cuda_kernels
from hoigs.rasterizers.warp.intersect.cuda_source import BLOCK, PLAN_BLOCK
from hoigs.rasterizers.warp.intersect.tile_spans import TILE_WIDTH

# For how many tile intersections to allocate memory, without waiting for the device.

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

    def now(self) -> int:
        """Intersections for which the next render of a known size would allocate."""
        return self._grown(int(self._largest[0]))

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


class Scratch:
    """What is needed only while intersections are made; one for each stream, reused.

    Attributes:
        counts: [tiles] int32, zero between uses. sums: one for each block of Gaussians.
    """

    def __init__(self, device: torch.device) -> None:
        self.counts = torch.zeros(0, dtype=torch.int32, device=device)
        self.sums = torch.empty(0, dtype=torch.int32, device=device)

    def for_splats(self, count: int, tiles: int) -> None:
        if self.counts.numel() < tiles:
            self.counts = self.counts.new_zeros(tiles)
        if self.sums.numel() * BLOCK < count:
            self.sums = self.sums.new_empty(-(-count // BLOCK))


class Intersector:
    """Makes the tile intersections of renders on one device.

    Only a render with more Gaussians or more tiles than any before it waits for the device, to
    count its intersections. A later one that exceeds the capacity uses one shared list, and the
    next render allocates more.

    Args:
        streams: what runs the kernels.
        capacity: for how many intersections to allocate.
    """

    def __init__(self, streams: CudaStreams, capacity: IntersectionCapacity) -> None:
        self.streams, self.capacity = streams, capacity
        self._scratch: dict[CudaStream, Scratch] = {}
        self._lock = threading.Lock()  # the kernels of two renders must not mix in one scratch

    def intersect(self, projected: Projected, settings: Settings) -> TileIntersections:
        tiles_x, tiles_y = -(-settings.width // TILE_WIDTH), -(-settings.height // TILE_HEIGHT)
        count, tiles = projected.depths.shape[0], tiles_x * tiles_y
        depths, records = projected.drawn_depths, projected.records
        new = depths.new_empty
        first_partial, tiles_per_gaussian = new((2, count), dtype=torch.int32).unbind()
        offsets = new(3 * tiles + 2, dtype=torch.int32)
        stream = self.streams.current(depths.device.index)
        with self._lock:
            scratch = self._scratch_of(stream, depths.device)
            scratch.for_splats(count, tiles)
            splats = [records, depths, count, TILE_HEIGHT, tiles_x, tiles_y, settings.width]
            splats += [scratch.counts, first_partial, tiles_per_gaussian, scratch.sums]
            blocks = -(-count // BLOCK)
            stream.blocks(cuda_kernels.count_intersections, blocks, BLOCK, splats)
            capacity = self.capacity.of(count, tiles)
            plan = [depths, count, tiles, capacity, 0, scratch.counts, scratch.sums, offsets]
            known = capacity > 0
            if not known:
                capacity = self._count(stream, plan, offsets, count, tiles)
            indices = new((capacity, 2), dtype=torch.int32)
            keys, owners = new(capacity, dtype=torch.int64), new(capacity, dtype=torch.int32)
            if known:
                largest = self.capacity.largest, self.capacity.largest_on_host
                arguments = [*plan, keys, indices, *largest]
                stream.blocks(cuda_kernels.plan_intersections, 1, PLAN_BLOCK, arguments)
            arguments = [*splats, offsets, keys, owners]
            stream.blocks(cuda_kernels.place_intersections, blocks, BLOCK, arguments)
        return TileIntersections(
            TILE_HEIGHT, tiles_x, tiles_y, offsets, indices, first_partial, tiles_per_gaussian,
            keys, owners,
        )  # fmt: skip

    def _count(
        self, stream: CudaStream, plan: list, offsets: Tensor, count: int, tiles: int
    ) -> int:
        """Capacity for this render, by waiting for its number of intersections."""
        if torch.cuda.is_current_stream_capturing():
            raise RenderError(
                f"WarpRasterizer: {count} Gaussians and {tiles} tiles are more than it has drawn "
                "so far, and their intersections cannot be counted while a CUDA graph is captured: "
                "render once before the capture"
            )
        plan[4] = 1  # count only
        none = offsets.new_empty(0)
        largest = self.capacity.largest, self.capacity.largest_on_host
        arguments = [*plan, none.long(), none, *largest]
        stream.blocks(cuda_kernels.plan_intersections, 1, PLAN_BLOCK, arguments)
        found = int(offsets[tiles])
        if found == INT32:
            self._scratch.clear()  # its counts are not zero
            check_addressable(
                INT32 + 1, f"the intersections of {count} Gaussians with {tiles} tiles"
            )
        return self.capacity.counted(count, tiles, found)

    def _scratch_of(self, stream: CudaStream, device: torch.device) -> Scratch:
        """Kept for each stream; a graph that is captured gets one of its own."""
        if torch.cuda.is_current_stream_capturing():
            self.capacity.keep_for_graphs()
            return Scratch(device)
        if stream not in self._scratch:
            self._scratch[stream] = Scratch(device)
        return self._scratch[stream]
