"""Splatting with NVIDIA Warp: one package for CPUs and CUDA, compiled on first use.

Importing this loads no Warp, nor does constructing a WarpRasterizer; its first render does.
"""

from hoigs.rasterizers.warp.rasterizer import WarpConfig, WarpRasterizer

__all__ = ["WarpConfig", "WarpRasterizer"]
