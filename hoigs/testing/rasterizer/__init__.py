"""Conformance of rasterizers: `CHECKS`, the checks R01 to R86 of a backend on a device.

    subject = RasterizerSubject(MyRasterizer(), torch.device("cpu"))
    print(run_checks(CHECKS, subject))

The rules are those of `hoigs.core.maths.projection`; the reference is `rasterizer:oracle`.
"""

from __future__ import annotations

from hoigs.testing.checks import run_checks
from hoigs.testing.rasterizer import (  # importing them fills CHECKS
    contract,
    drawing,
    gradients,
    optics,
)
from hoigs.testing.rasterizer.subject import CHECKS, RasterizerSubject, subject

__all__ = [
    "CHECKS", "RasterizerSubject", "contract", "drawing", "gradients", "optics", "run_checks",
    "subject",
]  # fmt: skip
