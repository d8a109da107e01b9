"""Kernels that replace functions of `core.maths` on a device, and CUDA graphs."""
