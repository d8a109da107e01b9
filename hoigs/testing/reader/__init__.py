"""Conformance of clip readers: `CHECKS`, C01 to C09, on folders that the kit writes."""

from __future__ import annotations

from hoigs.testing.reader import folders, reading
from hoigs.testing.reader.subject import CHECKS, ReaderSubject, subject

MODULES = (folders, reading)  # importing them fills CHECKS

__all__ = ["CHECKS", "MODULES", "ReaderSubject", "subject"]
