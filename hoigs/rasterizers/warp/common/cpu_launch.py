"""Launches on a CPU, as `hoigs.core.cpu_kernels.launch` makes them."""

from hoigs.core.cpu_kernels.launch import flat, prepared, vector_sizes

__all__ = ["flat", "prepared", "vector_sizes"]
