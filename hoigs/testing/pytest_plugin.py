"""conformance: the checks of a component as parameters of a pytest function."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hoigs.testing.checks import Check, Outcome, refuse_unknown
from hoigs.testing.runner import Candidate, Options, require_offered

if TYPE_CHECKING:
    from hoigs.core.registry.registry import Registry


class Case:
    """One check of one component, as a callable."""

    def __init__(self, candidate: Candidate, check: Check[Any], expected: str | None) -> None:
        self.candidate, self.check, self.expected = candidate, check, expected

    def __call__(self) -> None:
        """Run the check; fails, skips or xfails through pytest."""
        import pytest

        require_offered(self.candidate.key, self.candidate.registry)
        result = self.candidate.result(self.check, self.expected)
        message = f"{result.id} {result.title}: {result.why}"
        if result.outcome in (Outcome.FAILED, Outcome.UNEXPECTED_PASS):
            pytest.fail(message, pytrace=False)
        if result.outcome is Outcome.SKIPPED:
            pytest.skip(message)
        if result.outcome is Outcome.EXPECTED_FAILURE:
            pytest.xfail(message)


def conformance(
    key: str,
    *,
    expected_failures: Mapping[str, str] | None = None,
    settings: Mapping[str, Any] | None = None,
    device: str = "cpu",
    folder: str | Path | None = None,
    registry: Registry | None = None,
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorator for a pytest function of one argument `check`: one test for each check.

        @conformance("deformation:bspline", expected_failures={"D09": "it jumps by design"})
        def test_conforms(check):
            check()

    Args:
        expected_failures, settings, device, folder, registry: as `hoigs.testing.check`.

    Raises:
        ValueError: `expected_failures` names an unknown check.
    """
    import pytest

    options = Options(settings or {}, device, None if folder is None else Path(folder))
    candidate = Candidate(key, options, registry)
    expected = dict(expected_failures or {})
    checks = candidate.checks()
    refuse_unknown(expected, [check.id for check in checks])
    cases = [
        pytest.param(Case(candidate, check, expected.get(check.id)), id=check.id)
        for check in checks
    ]
    return pytest.mark.parametrize("check", cases)
