"""Conformance of exporters: `CHECKS`, X01 to X10, on a tiny synthetic scene."""

from __future__ import annotations

from hoigs.testing.exporter import contract, files
from hoigs.testing.exporter.subject import CHECKS, ExporterSubject, subject

MODULES = (contract, files)  # importing them fills CHECKS

__all__ = ["CHECKS", "MODULES", "ExporterSubject", "subject"]
