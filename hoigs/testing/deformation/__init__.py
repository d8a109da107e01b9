"""Conformance of deformations: `CHECKS`, D01 to D34.

    subject = DeformationSubject(MyDeformation, MyConfig())
    print(run_checks(CHECKS, subject))

Subjects are built, as a spec builds them, for the human or the object of a tiny synthetic clip
(`hoigs.testing.material`).
"""

from __future__ import annotations

from hoigs.testing.deformation import (
    contract,
    gradients,
    persistence,
    provided,
    residuals,
    time,
    topology,
    values,
)
from hoigs.testing.deformation.subject import CHECKS, DeformationSubject, subject

MODULES = (
    contract,
    gradients,
    persistence,
    provided,
    residuals,
    time,
    topology,
    values,
)  # importing them fills CHECKS

__all__ = ["CHECKS", "MODULES", "DeformationSubject", "subject"]
