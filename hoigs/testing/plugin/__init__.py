"""Conformance of plugins of any kind: `CHECKS`, P01 to P13, of one component of a registry."""

from __future__ import annotations

from hoigs.testing.plugin import imports, offers, settings
from hoigs.testing.plugin.subject import CHECKS, PluginSubject, subject

MODULES = (imports, offers, settings)  # importing them fills CHECKS

__all__ = ["CHECKS", "MODULES", "PluginSubject", "subject"]
