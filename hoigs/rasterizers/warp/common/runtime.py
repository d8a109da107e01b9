"""Warp and its flags, as `hoigs.core.cpu_kernels.runtime` has them."""

from hoigs.core.cpu_kernels.runtime import CPU_FLAGS, wp

__all__ = ["CPU_FLAGS", "wp"]
