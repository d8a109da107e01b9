"""Conformance of density controls: `CHECKS`, N01 to N13, on clouds that the kit makes."""

from __future__ import annotations

from hoigs.testing.density import decisions, promises
from hoigs.testing.density.subject import CHECKS, DensitySubject, subject

FAMILIES = (decisions, promises)  # importing them fills CHECKS

__all__ = ["CHECKS", "FAMILIES", "DensitySubject", "subject"]
