"""Rendering on a CPU.

choose            which kernels and scheduler a machine can use
native            NativePipeline: vectorised kernels (native_kernels, *_source)
portable          PortablePipeline: the kernels of CUDA as scalar code
pipeline          what both have in common
cores, workers    how launches are spread over cores
"""
