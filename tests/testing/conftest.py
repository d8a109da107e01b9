"""Which check killed which mutant: a table at the end of the run."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import pytest

from hoigs.testing.checks import Check, Outcome, run_checks

KILLS = pytest.StashKey[list[tuple[str, str, str]]]()


def pytest_configure(config: pytest.Config) -> None:
    config.stash[KILLS] = []


@pytest.fixture
def kill(request: pytest.FixtureRequest) -> Callable[..., None]:
    """kill(checks, subject, id, also): `id`, and no check but those in `also`, must find it."""

    def run(
        checks: Iterable[Check[Any]], subject: Any, id: str, mutant: str, also: Iterable[str] = ()
    ) -> None:
        report = run_checks(checks, subject)
        failed = {r.id: r.why for r in report.results if r.outcome is Outcome.FAILED}
        assert id in failed, f"{id} let it live: {report}"
        assert set(failed) - {id} == set(also), failed
        assert "TypeCheckError" not in failed[id] and "NameError" not in failed[id], failed[id]
        title = next(check.title for check in checks if check.id == id)
        killers = " ".join(sorted(failed))
        request.config.stash[KILLS].append((killers, mutant, title))

    return run


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    if config.stash[KILLS]:
        terminalreporter.section("check -> mutant that it killed")
        for killers, mutant, title in sorted(config.stash[KILLS]):
            terminalreporter.write_line(f"{killers:<8} {mutant:<34} {title}")
