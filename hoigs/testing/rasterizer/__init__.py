"""Conformance of rasterizers: `CHECKS`, the checks R01 to R86 of a backend on a device.

    subject = RasterizerSubject(MyRasterizer(), torch.device("cpu"))
    print(run_checks(CHECKS, subject))

The rules are those of `hoigs.core.maths.projection`; the reference is `rasterizer:oracle`.
"""

from __future__ import annotations

from hoigs.testing.checks import run_checks
from hoigs.testing.rasterizer import contract, gradients
from hoigs.testing.rasterizer import contract as bad_rows
from hoigs.testing.rasterizer import drawing as pictures
from hoigs.testing.rasterizer import drawing as rows
from hoigs.testing.rasterizer import drawing as rules
from hoigs.testing.rasterizer.subject import CHECKS, RasterizerSubject, subject

FAMILIES = (rules, pictures, rows, gradients, bad_rows, contract)  # importing them fills CHECKS

__all__ = ["CHECKS", "FAMILIES", "RasterizerSubject", "run_checks", "subject"]
