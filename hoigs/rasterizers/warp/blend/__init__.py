"""Compositing with a warp of lanes per tile, forward and backward.

arguments        arguments of the tile kernels of all devices
pixel_kernels    for CUDA, and as scalar code for a CPU; their C++ in pixel_source
gather_kernels   sums of partial gradients on CUDA
"""
