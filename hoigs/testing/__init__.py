"""The conformance kit: small checks with stable ids that hold a plugin to its interface.

    report = hoigs.testing.check("deformation:chs")      # a Report; print it
    @hoigs.testing.conformance("deformation:chs")        # pytest: one test a check
    $ hoigs plugins check deformation:chs                # the same from a shell

It needs no pytest. Each interface has its list of checks (`hoigs.testing.rasterizer.CHECKS`), each
check says by tags that a component declares, never by names, what it needs; every outcome is
counted. Importing this module loads no torch.
"""

from __future__ import annotations

from hoigs.testing.checks import Check, CheckError, CheckList, Outcome, Report, Result, run_checks
from hoigs.testing.door import Options, check, check_plugin
from hoigs.testing.pytest_door import conformance

__all__ = [
    "Check",
    "CheckError",
    "CheckList",
    "Options",
    "Outcome",
    "Report",
    "Result",
    "check",
    "check_plugin",
    "conformance",
    "run_checks",
]
