"""Conformance of body models: `CHECKS`, B01 to B13."""

from __future__ import annotations

from hoigs.testing.body import motion, shape
from hoigs.testing.body.subject import CHECKS, BodySubject, subject

MODULES = (motion, shape)  # importing them fills CHECKS

__all__ = ["CHECKS", "MODULES", "BodySubject", "subject"]
