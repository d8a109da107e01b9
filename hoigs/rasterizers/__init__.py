"""Rasterizers: each draws Gaussians by the rules of `hoigs.core.maths.projection`.

- `warp`: rasterizer:warp, Warp kernels for CPUs and CUDA.
- `torch_tiles`: rasterizer:torch, plain torch, by autograd.
- `oracle`: rasterizer:oracle, float64, the reference that the others are tested against.
- `gsplat`: rasterizer:gsplat, the kernels of gsplat.
- `compositing`: what the torch backends share.
"""
