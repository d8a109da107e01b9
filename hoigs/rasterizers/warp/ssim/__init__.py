"""SSIM and its gradient as Warp kernels, for CPUs and CUDA.

    function     mean_ssim and ssim_map, differentiable functions of torch tensors: the entry
    definition   constants, and the formula as C++
    strips       on CPUs; the kernel in strip_kernels and strip_source
    tiles        on CUDA; the kernels in tile_kernels and tile_source

It stands beside the rasterizer because every training step runs both, on the same launchers.
`hoigs.metrics.ssim` calls it with backend="warp" and holds the torch version that the tests compare
it with. Importing this loads no Warp; the first call compiles the kernels into Warp's cache.
"""

from hoigs.rasterizers.warp.ssim.function import mean_ssim, ssim_map

__all__ = ["mean_ssim", "ssim_map"]
