"""Conformance of density controls: `CHECKS`, N01 to N13, on synthetic Gaussians."""

from __future__ import annotations

from hoigs.testing.density import contract, decisions
from hoigs.testing.density.subject import CHECKS, DensitySubject, subject

MODULES = (contract, decisions)  # importing them fills CHECKS

__all__ = ["CHECKS", "MODULES", "DensitySubject", "subject"]
