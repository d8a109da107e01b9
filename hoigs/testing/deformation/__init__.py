"""Conformance of deformations: `CHECKS`, D01 to D34.

    subject = DeformationSubject(MyDeformation, MyConfig())
    print(run_checks(CHECKS, subject))

They are built, as a spec would build them, for the human or the object of a tiny clip that the kit
makes itself (hoigs.testing.material).
"""

from __future__ import annotations

from hoigs.testing.deformation import (
    gradients,
    keeping,
    promises,
    provided,
    residuals,
    time,
    topology,
    values,
)
from hoigs.testing.deformation.subject import CHECKS, DeformationSubject, subject

# importing them fills CHECKS
FAMILIES = (values, gradients, time, topology, keeping, residuals, promises, provided)

__all__ = ["CHECKS", "FAMILIES", "DeformationSubject", "subject"]
