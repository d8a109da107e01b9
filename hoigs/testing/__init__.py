"""The conformance kit: small checks, with stable ids, that a plugin keeps its interface's contract.

    report = hoigs.testing.check("deformation:chs")      # a Report; print it
    @hoigs.testing.conformance("deformation:chs")        # pytest: one test for each check
    $ hoigs plugins check deformation:chs                # the same from a shell

- `runner.check`, `runner.check_plugin`: run the checks of a component or of a whole plugin.
- `pytest_plugin.conformance`: the same as pytest parameters.
- `checks`: Check, CheckList and Report. Each interface has a package with its CHECKS, for example
  `hoigs.testing.deformation`.

Whether a check applies depends on what a component declares, never on its name. It needs no pytest,
and importing this module loads no torch.
"""

from __future__ import annotations

from hoigs.testing.checks import Check, CheckError, CheckList, Outcome, Report, Result, run_checks
from hoigs.testing.runner import Options, check, check_plugin, conformance

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
