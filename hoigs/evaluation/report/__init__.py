"""The report of a run: `write_report`."""

from __future__ import annotations

from hoigs.evaluation.report.write import write_report

__all__ = ["write_report"]
