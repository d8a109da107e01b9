"""SSIM on CUDA: one block of threads for a tile of one channel. It runs on a CPU too, for tests."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from hoigs.core.cpu_kernels.launch import prepared
from hoigs.rasterizers.warp.cuda.launch import CudaStreams
from hoigs.rasterizers.warp.ssim.tile_kernels import backward_tiles, forward_tiles
from hoigs.rasterizers.warp.ssim.tile_source import SIDE, THREADS


class TileKernels:
    """Two kernels, on torch's current stream; nothing waits for the device."""

    max_channels: int | None = None

    def __init__(self) -> None:
        self._streams = CudaStreams()

    def mean(
        self, image: Tensor, target: Tensor, with_gradient: bool
    ) -> tuple[Tensor, tuple[Tensor, ...]]:
        kept = image.new_empty(3 * image.numel() if with_gradient else 0)
        sums = self._forward(image, target, image.new_empty(0), kept)
        value = (sums.sum(dtype=torch.float64) / image.numel()).float()
        return value, (image, target, kept)

    def gradient(self, kept: tuple[Tensor, ...], upstream: Tensor) -> Tensor:
        image, target, planes = kept
        result = torch.empty_like(image)
        self._launch(backward_tiles, image, [image, target, planes, upstream, result])
        return result

    def map(self, image: Tensor, target: Tensor) -> Tensor:
        result = torch.empty_like(image)
        self._forward(image, target, result, image.new_empty(0))
        return result

    def _forward(self, image: Tensor, target: Tensor, result: Tensor, kept: Tensor) -> Tensor:
        sums = image.new_empty(_tiles(image))
        flags = [int(result.numel() > 0), int(kept.numel() > 0)]
        self._launch(forward_tiles, image, [image, target, *flags, sums, result, kept])
        return sums

    def _launch(self, kernel: Any, image: Tensor, arguments: list[Any]) -> None:
        arguments = [*image.shape, *arguments]
        if image.is_cuda:
            self._streams.current().blocks(kernel, _tiles(image), THREADS, arguments)
        else:
            prepared(kernel, _tiles(image), arguments).launch()


def _tiles(image: Tensor) -> int:
    batch, height, width, channels = image.shape
    return batch * channels * -(-height // SIDE) * -(-width // SIDE)
