"""SSIM on CUDA: one block of threads for a tile of one channel. It runs on a CPU too, for tests."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from hoigs.rasterizers.warp.calls import flat
from hoigs.rasterizers.warp.runtime import wp
from hoigs.rasterizers.warp.ssim.tile_kernels import backward_tiles, forward_tiles
from hoigs.rasterizers.warp.ssim.tile_source import SIDE, THREADS


class TilePath:
    """Two kernels, on torch's current stream; nothing waits for the device."""

    max_channels: int | None = None

    def __init__(self) -> None:
        self._streams: dict[tuple[int, int], Any] = {}

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
        arguments = [*_sizes(image), flat(image), flat(target), flat(planes)]
        self._launch(backward_tiles, image, [*arguments, flat(upstream), flat(result)])
        return result

    def map(self, image: Tensor, target: Tensor) -> Tensor:
        result = torch.empty_like(image)
        self._forward(image, target, result, image.new_empty(0))
        return result

    def _forward(self, image: Tensor, target: Tensor, result: Tensor, kept: Tensor) -> Tensor:
        sums = image.new_empty(_tiles(image))
        arguments = [*_sizes(image), flat(image), flat(target), int(result.numel() > 0)]
        arguments += [int(kept.numel() > 0), flat(sums), flat(result), flat(kept)]
        self._launch(forward_tiles, image, arguments)
        return sums

    def _launch(self, kernel: Any, image: Tensor, arguments: list[Any]) -> None:
        if not image.is_cuda:
            wp.launch(kernel, dim=_tiles(image), inputs=arguments, device="cpu")
            return
        current = torch.cuda.current_stream(image.device)
        key = (current.device_index, current.cuda_stream)
        if key not in self._streams:
            self._streams[key] = wp.stream_from_torch(current)
        wp.launch(
            kernel,
            dim=_tiles(image) * THREADS,
            inputs=arguments,
            stream=self._streams[key],
            block_dim=THREADS,
        )


def _sizes(image: Tensor) -> list[int]:
    return list(image.shape)


def _tiles(image: Tensor) -> int:
    batch, height, width, channels = image.shape
    return batch * channels * -(-height // SIDE) * -(-width // SIDE)
