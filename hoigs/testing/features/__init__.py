"""Conformance of feature extractors: `CHECKS`, F01 to F13, on a motion that provides everything."""

from __future__ import annotations

from hoigs.testing.features import persistence, tokens
from hoigs.testing.features.subject import CHECKS, FeaturesSubject, subject

MODULES = (persistence, tokens)  # importing them fills CHECKS

__all__ = ["CHECKS", "MODULES", "FeaturesSubject", "subject"]
