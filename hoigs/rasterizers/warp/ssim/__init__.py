"""SSIM and its gradient as Warp kernels, for CPUs and CUDA.

Not a rasterizer, but its neighbour: it stands behind every render in training, and runs on the same
runtime, workers and streams. `evaluation.metrics.ssim` is its face (`backend="warp"`), and holds
the float64 twin in torch that the tests compare it with.

Importing this loads no Warp; the first call does, and compiles the kernels into Warp's cache.
"""

from hoigs.rasterizers.warp.ssim.function import mean_ssim, ssim_map

__all__ = ["mean_ssim", "ssim_map"]
