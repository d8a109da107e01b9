"""Tile lists on CUDA, made without waiting for the device.

No kernel's size depends on how many pairs of splat and tile there are:

    count    a thread a Gaussian: how many tiles its ellipse touches, and one more for each of them
    plan     one block: running sums over tiles and Gaussians, and whether the pairs fit
    place    a thread a Gaussian: its keys (depth, slot) into the lists of its tiles, in any order
    sort     a warp or a block a tile: by depth; slots rise with rows, so ties go by row

`Scratch.counts` is zero before and after, since `place` counts down where `count` counted up.

When the pairs do not fit, `plan` sorts all drawn Gaussians into one list, which every tile then
walks, taking those whose box it touches. It is slower, never wrong: the picture is the same. Its
length stands behind the offsets, -1 where each tile has its own list.
"""

from __future__ import annotations

import threading

import torch
from torch import Tensor

from hoigs.core.errors import RenderError
from hoigs.rasterizers.warp import list_kernels, list_source, order_source, pixel_source
from hoigs.rasterizers.warp.arguments import Projected
from hoigs.rasterizers.warp.cuda_calls import CudaStream, CudaStreams
from hoigs.rasterizers.warp.frame import INT32, Lists, Settings, check_addressable
from hoigs.rasterizers.warp.pair_room import PairRoom
from hoigs.rasterizers.warp.tile_spans import TILE_WIDTH

SORTED_BY_BLOCK = 4  # tiles; about as many blocks as there are long lists


class Scratch:
    """What is needed only while lists are made; one for each stream, used again and again.

    Attributes:
        counts: [tiles] int32, zero between uses. sums: one for each block of Gaussians.
        keys: [capacity] int64. owners: [capacity] int32.
    """

    def __init__(self, device: torch.device) -> None:
        self.counts = torch.zeros(0, dtype=torch.int32, device=device)
        self.sums = torch.empty(0, dtype=torch.int32, device=device)
        self.keys = torch.empty(0, dtype=torch.int64, device=device)
        self.owners = torch.empty(0, dtype=torch.int32, device=device)

    def for_splats(self, count: int, tiles: int) -> None:
        if self.counts.numel() < tiles:
            self.counts = self.counts.new_zeros(tiles)
        if self.sums.numel() * list_source.BLOCK < count:
            self.sums = self.sums.new_empty(-(-count // list_source.BLOCK))

    def for_pairs(self, capacity: int) -> None:
        if self.keys.numel() < capacity:
            self.keys = self.keys.new_empty(capacity)
            self.owners = self.owners.new_empty(capacity)


class ListMaker:
    """Makes the tile lists of renders on one device.

    Only a render with more Gaussians or more tiles than any before it waits, for its number of
    pairs. If a later one has more pairs than there is room for, its tiles share one list of all
    Gaussians by depth (see `list_source`): the picture is the same, drawing it takes longer, the
    sums of its gradients are in no fixed order, and the next render finds more room.

    Args:
        streams: what runs the kernels.
        device: where.
    """

    def __init__(self, streams: CudaStreams, device: torch.device) -> None:
        self.streams = streams
        self.room = PairRoom(device)
        self._scratch: dict[int, Scratch] = {}
        self._lock = threading.Lock()  # the kernels of two renders must not mix in one scratch

    def make(self, projected: Projected, settings: Settings) -> Lists:
        rows = pixel_source.TILE_ROWS
        across, down = -(-settings.width // TILE_WIDTH), -(-settings.height // rows)
        count, tiles = projected.depths.shape[0], across * down
        depths, records = projected.drawn_depths, projected.records
        new = depths.new_empty
        first, slots = new((2, count), dtype=torch.int32).unbind()
        offsets = new(2 * tiles + 3, dtype=torch.int32)
        with self._lock:
            scratch = self._scratch_of_stream(depths.device)
            scratch.for_splats(count, tiles)
            splats = [records, depths, count, rows, across, down, settings.width, scratch.counts]
            blocks = -(-count // list_source.BLOCK)
            stream = self.streams.current()
            run = stream.blocks
            run(list_kernels.count_pairs, blocks, list_source.BLOCK,
                [*splats, first, slots, scratch.sums])  # fmt: skip
            capacity = self.room.capacity(count, tiles)
            plan = [depths, count, tiles, capacity, 0, scratch.counts, scratch.sums, offsets]
            if capacity == 0:
                capacity = self._measure(stream, plan, offsets, count, tiles)
                scratch.for_pairs(capacity)
                pairs = new((capacity, 2), dtype=torch.int32)
            else:
                scratch.for_pairs(capacity)
                pairs = new((capacity, 2), dtype=torch.int32)
                run(list_kernels.plan_lists, 1, order_source.PLAN_BLOCK,
                    [*plan, scratch.keys, pairs, self.room.seen, self.room.told])  # fmt: skip
            run(list_kernels.place_pairs, blocks, list_source.BLOCK,
                [*splats, first, slots, scratch.sums, offsets, scratch.keys, scratch.owners],
            )  # fmt: skip
            sorters = -(-tiles // SORTED_BY_BLOCK)
            run(list_kernels.sort_lists, sorters, order_source.SORT_BLOCK,
                [sorters, tiles, offsets, scratch.keys, scratch.owners, pairs])  # fmt: skip
        return Lists(rows, across, down, pairs, offsets, first, slots)

    def _measure(
        self, stream: CudaStream, plan: list, offsets: Tensor, count: int, tiles: int
    ) -> int:
        """Capacity for this render, by waiting for its number of pairs."""
        if torch.cuda.is_current_stream_capturing():
            raise RenderError(
                f"WarpRasterizer: {count} Gaussians and {tiles} tiles are more than it has drawn; "
                "how many splats that makes cannot be asked while a CUDA graph is captured: render "
                "once before the capture"
            )
        plan[4] = 1  # measuring
        none = offsets.new_empty(0)
        stream.blocks(
            list_kernels.plan_lists, 1, order_source.PLAN_BLOCK,
            [*plan, none.long(), none, self.room.seen, self.room.told],
        )  # fmt: skip
        pairs = int(offsets[tiles])
        if pairs == INT32:
            self._scratch.clear()  # its counts are not zero
            check_addressable(INT32 + 1, f"the splats of {count} Gaussians in {tiles} tiles")
        return self.room.measured(count, tiles, pairs)

    def _scratch_of_stream(self, device: torch.device) -> Scratch:
        """Kept for each stream; a graph that is captured gets one of its own."""
        if torch.cuda.is_current_stream_capturing():
            self.room.keep_for_graphs()
            return Scratch(device)
        stream = torch.cuda.current_stream().cuda_stream
        if stream not in self._scratch:
            self._scratch[stream] = Scratch(device)
        return self._scratch[stream]
