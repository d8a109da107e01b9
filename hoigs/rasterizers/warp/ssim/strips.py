"""SSIM on CPUs: the kernel of `strip_source` on all cores."""

from __future__ import annotations

import torch
from torch import Tensor

from hoigs.core.cpu_kernels.launch import prepared
from hoigs.core.cpu_kernels.workers import SerialWorkers, ThreadWorkers
from hoigs.rasterizers.warp.ssim.strip_kernels import similarity_strips
from hoigs.rasterizers.warp.ssim.strip_source import MAX_CHANNELS, STRIP

WORTHWHILE = 2**15  # an image with so many floats takes as long as waking another core
LEAST_LINES = 64  # of a band: it computes 10 lines beyond each end again


class StripKernels:
    """Value and gradient in one pass; backward only scales the gradient by the upstream one.

    Keeping the three images from which the gradient is blurred, as the CUDA kernels do, would move
    three times as much memory.
    """

    max_channels: int | None = MAX_CHANNELS

    def mean(
        self, image: Tensor, target: Tensor, with_gradient: bool
    ) -> tuple[Tensor, tuple[Tensor, ...]]:
        gradient = torch.empty_like(image) if with_gradient else image.new_empty(0)
        sums = _run(image, target, image.new_empty(0), gradient)
        value = (sums.sum(dtype=torch.float64) / image.numel()).float()
        return value, (gradient,)

    def gradient(self, kept: tuple[Tensor, ...], upstream: Tensor) -> Tensor:
        return kept[0] * upstream

    def map(self, image: Tensor, target: Tensor) -> Tensor:
        result = torch.empty_like(image)
        _run(image, target, result, image.new_empty(0))
        return result


def _run(image: Tensor, target: Tensor, result: Tensor, gradient: Tensor) -> Tensor:
    """Fill map and gradient where they are not empty; returns sums of SSIM [B, H, strips]."""
    batch, height, width, channels = image.shape
    length = width * channels
    strips = -(-length // STRIP)
    strip_width = 16 * -(-length // (16 * strips))
    cores = max(1, min(torch.get_num_threads(), image.numel() // WORTHWHILE))
    wanted = 2 * cores if cores > 1 else 1  # work items: cores may be of unequal speed
    bands = max(1, min(-(-wanted // (batch * strips)), height // LEAST_LINES))
    sums = image.new_empty(batch, height, strips)
    arguments = [
        torch.zeros(1, dtype=torch.int32), batch, height, width, channels, strips, strip_width,
        bands, -(-height // bands), image, target, 1.0 / image.numel(), int(result.numel() > 0),
        int(gradient.numel() > 0), sums, result, gradient,
    ]  # fmt: skip
    launches = [prepared(similarity_strips, 1, arguments)] * cores
    (SerialWorkers() if cores == 1 else ThreadWorkers()).run(launches)
    return sums
