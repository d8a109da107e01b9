"""CheckResult: whether a check passed, and by which numbers."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CheckResult:
    """Result of one check. measured: in words, with the deciding numbers."""

    passed: bool
    measured: str
