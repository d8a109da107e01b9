"""What a check found: whether it holds, and by which numbers."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """The answer of one check. measured: in words, with the numbers that decided."""

    passed: bool
    measured: str


def joined(findings: dict[str, Finding]) -> Finding:
    """Several answers as one: passed if all are; those that failed are named first."""
    order = sorted(findings.items(), key=lambda item: item[1].passed)
    words = "; ".join(f"{name}: {finding.measured}" for name, finding in order)
    return Finding(all(f.passed for f in findings.values()), words)
