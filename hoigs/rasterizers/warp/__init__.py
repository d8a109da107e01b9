"""Splatting with NVIDIA Warp, for CPUs and CUDA; kernels are compiled on first use.

    rasterizer          WarpRasterizer and its settings: the entry
    autograd            a render as one differentiable function
    input_validation    from Gaussians, Camera and RenderRequest to the tensors of a render
    graph_capture       CapturedRender: a render as a CUDA graph
    cpu, cuda           the stages of a render on each device
    project, intersect, blend   the kernels of each stage
    ssim                SSIM and its gradient as kernels
    common              what all of these share

Neither importing this nor constructing a WarpRasterizer loads Warp; its first render does.
"""

from hoigs.rasterizers.warp.rasterizer import WarpConfig, WarpRasterizer

__all__ = ["WarpConfig", "WarpRasterizer"]
