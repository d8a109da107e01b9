"""Conformance of interactions: `CHECKS`, I01 to I15, on synthetic humans and objects."""

from __future__ import annotations

from hoigs.testing.interaction import combinations, persistence, reach
from hoigs.testing.interaction.subject import CHECKS, InteractionSubject, subject

MODULES = (combinations, persistence, reach)  # importing them fills CHECKS

__all__ = ["CHECKS", "MODULES", "InteractionSubject", "subject"]
