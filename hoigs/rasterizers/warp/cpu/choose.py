"""Which CPU kernels this machine can run, found by compiling them."""

from __future__ import annotations

import warnings
from typing import Literal

import torch

from hoigs.core.errors import RenderError

Kernels = Literal["auto", "native", "portable"]


def choose_kernels(requested: Kernels) -> tuple[Literal["native", "portable"], str]:
    """The kernels to use and a line with the reason.

    "auto" takes the native ones where they compile, else the portable ones with a warning.

    Raises:
        RenderError: "native" is requested and does not compile here.
    """
    if requested == "portable":
        return "portable", "requested"
    try:
        lanes = vector_lanes()
    except Exception as error:  # Warp raises nothing narrower when a build fails
        reason = f"the native kernels do not compile here: {error}"
        if requested == "native":
            raise RenderError(
                f'WarpRasterizer: {reason}; use cpu_kernels="portable" (about ten times slower)'
            ) from error
        warnings.warn(f"WarpRasterizer: {reason}; the portable ones are slower", stacklevel=2)
        return "portable", reason
    return "native", f"they compile, with vectors of {lanes} floats"


def vector_lanes() -> int:
    """Floats in a vector of the native kernels: 16 with AVX-512, else 8. Compiles them."""
    from hoigs.core.cpu_kernels.launch import prepared
    from hoigs.rasterizers.warp.cpu import native_kernels

    lanes = torch.zeros(1, dtype=torch.int32)
    prepared(native_kernels.count_lanes, 1, [lanes]).launch()
    return int(lanes)
