"""Rendering on CUDA.

pipeline        CudaPipeline: the stages of a render
intersections   tile intersections without waiting for the device
capacity        for how many intersections memory is allocated
"""
