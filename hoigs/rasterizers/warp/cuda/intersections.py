"""Tile intersections on CUDA, found without waiting for the device.

No kernel's size depends on how many intersections there are:

    count    a thread a Gaussian: how many tiles its ellipse touches, and one more for each of them
    plan     one block: running sums over tiles and Gaussians, and whether the intersections fit
    place    a thread a Gaussian: its keys (depth, partial) into its tiles, in any order

`blend` sorts them by depth, as far as it draws. Partials are numbered by Gaussian, so that ties are
broken by index.

Where Gaussians are many, most of them are hidden, and so are most intersections. There all this is
done for the nearest sixth, and once that is drawn, for the others in tiles that it leaves open.

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
from hoigs.rasterizers.warp.intersect.cuda_source import BLOCK, PLAN_BLOCK, STATE_SIZE
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


# From how many Gaussians on, in all and for each tile, the nearest are drawn before the others.
# With fewer, the launches take longer than what they save. It depends on nothing else, so that two
# renders of the same input sum alike.
MANY, DENSE = 2**18, 48


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
        """Of all Gaussians, or of the nearest of many: where `counted` is given, others follow."""
        tiles_x, tiles_y = -(-settings.width // TILE_WIDTH), -(-settings.height // TILE_HEIGHT)
        count, tiles = projected.depths.shape[0], tiles_x * tiles_y
        depths = projected.drawn_depths
        new = depths.new_empty
        sizes = [count, count, 6 * tiles + STATE_SIZE]
        *of_gaussian, offsets = new(sum(sizes), dtype=torch.int32).split(sizes)
        splats = [projected.records, depths, count, TILE_HEIGHT, tiles_x, tiles_y, settings.width]
        many = count >= max(MANY, DENSE * tiles)
        part = cuda_kernels.NEAR if many else cuda_kernels.ALL
        stream = self.streams.current(depths.device.index)
        with self._lock:
            scratch = self._scratch_of(stream, depths.device)
            scratch.for_splats(count, tiles)
            counted = [*splats, scratch.counts, *of_gaussian, scratch.sums, offsets]
            capacity = self.capacity.of(count, tiles)
            known = capacity > 0
            if not known:
                capacity = self._measure(stream, counted, tiles, many)
            if known or many:
                _count(stream, part, counted)
            indices = new((capacity, 2), dtype=torch.int32)
            keys, owners = new(capacity, dtype=torch.int64), new(capacity, dtype=torch.int32)
            if known or many:
                self._plan(stream, part, counted, tiles, capacity, keys, indices)
            _place(stream, part, counted, keys, owners)
        return TileIntersections(
            TILE_HEIGHT, tiles_x, tiles_y, offsets, indices, *of_gaussian, keys, owners,
            counted if many else None,
        )  # fmt: skip

    def intersect_others(self, near: TileIntersections) -> None:
        """Add the other Gaussians where the nearest, once drawn, leave a tile open."""
        part, depths = cuda_kernels.OTHERS, near.counted[1]
        stream = self.streams.current(depths.device.index)
        with self._lock:
            _count(stream, part, near.counted)
            self._plan(stream, part, near.counted, near.tiles, near.count, near.keys, near.indices)
            _place(stream, part, near.counted, near.keys, near.owners)
        if self.capacity.of(len(depths), near.tiles) == 0:  # `_measure` was for this render alone
            self.capacity.counted(len(depths), near.tiles, int(self.capacity.largest[0]))

    def _plan(
        self, stream: CudaStream, part: int, counted: list, tiles: int, capacity: int,
        keys: Tensor, indices: Tensor,
    ) -> None:  # fmt: skip
        _, depths, count, *_, counts, _, _, sums, offsets = counted
        arguments = [part, depths, count, tiles, capacity, 0, counts, sums, offsets, keys, indices]
        arguments += [self.capacity.largest, self.capacity.largest_on_host]
        stream.blocks(cuda_kernels.plan_intersections, 1, PLAN_BLOCK, arguments)

    def _measure(self, stream: CudaStream, counted: list, tiles: int, many: bool) -> int:
        """Capacity for this render, by waiting for its number of intersections.

        Of many Gaussians it is that of all of them; later renders need less.
        """
        _, depths, count, *_, counts, _, _, sums, offsets = counted
        if torch.cuda.is_current_stream_capturing():
            raise RenderError(
                f"WarpRasterizer: {count} Gaussians and {tiles} tiles are more than it has drawn "
                "so far, and their intersections cannot be counted while a CUDA graph is captured: "
                "render once before the capture"
            )
        _count(stream, cuda_kernels.ALL, counted)
        none = offsets.new_empty(0)
        largest = [self.capacity.largest, self.capacity.largest_on_host]
        if many:
            largest = [torch.zeros_like(self.capacity.largest) for _ in range(2)]
        arguments = [cuda_kernels.ALL, depths, count, tiles, 0, 1, counts, sums, offsets]
        arguments += [none.long(), none, *largest]
        stream.blocks(cuda_kernels.plan_intersections, 1, PLAN_BLOCK, arguments)
        found = int(offsets[tiles])
        if found == INT32:
            self._scratch.clear()  # its counts are not zero
            check_addressable(
                INT32 + 1, f"the intersections of {count} Gaussians with {tiles} tiles"
            )
        if many:
            counts.zero_()
            return max(found, count)
        return self.capacity.counted(count, tiles, found)

    def _scratch_of(self, stream: CudaStream, device: torch.device) -> Scratch:
        """Kept for each stream; a graph that is captured gets one of its own."""
        if torch.cuda.is_current_stream_capturing():
            self.capacity.keep_for_graphs()
            return Scratch(device)
        if stream not in self._scratch:
            self._scratch[stream] = Scratch(device)
        return self._scratch[stream]


def _count(stream: CudaStream, part: int, counted: list) -> None:
    blocks = -(-counted[2] // BLOCK)
    stream.blocks(cuda_kernels.count_intersections, blocks, BLOCK, [part, *counted])


def _place(stream: CudaStream, part: int, counted: list, keys: Tensor, owners: Tensor) -> None:
    blocks = -(-counted[2] // BLOCK)
    arguments = [part, *counted, keys, owners]
    stream.blocks(cuda_kernels.place_intersections, blocks, BLOCK, arguments)
