"""Conformance of interactions: `CHECKS`, I01 to I13, on humans and objects that the kit makes."""

from __future__ import annotations

from hoigs.testing.interaction import company, keeping, reach
from hoigs.testing.interaction.subject import CHECKS, InteractionSubject, subject

FAMILIES = (reach, company, keeping)  # importing them fills CHECKS

__all__ = ["CHECKS", "FAMILIES", "InteractionSubject", "subject"]
