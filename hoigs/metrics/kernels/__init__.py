"""Warp kernels of SSIM and of the image loss, for CPUs and CUDA."""
