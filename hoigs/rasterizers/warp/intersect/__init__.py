"""Kernels that find which Gaussians touch each tile, nearest first.

tile_spans           which tiles a splat touches, as Warp functions
cuda_kernels         for CUDA; their C++ in count_place_source and plan_sort_source
portable_kernels     for the portable CPU kernels
"""
