"""The `kill` fixture, and a table of mutants and the checks that found them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import pytest
import torch

from hoigs.testing.checks import Check, Outcome, run_checks

KILL = "kill"


@pytest.fixture(scope="module", autouse=True)
def _one_torch_thread() -> Iterator[None]:
    """The tensors here are too small for two threads, which would only wait for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def kill(record_property: Callable[[str, object], None]) -> Callable[..., None]:
    """kill(checks, subject, id, mutant): the check `id`, and no other, must find it."""

    def run(checks: Iterable[Check[Any]], subject: Any, id: str, mutant: str) -> None:
        report = run_checks(checks, subject)
        failed = {r.id: r.why for r in report.results if r.outcome is Outcome.FAILED}
        assert id in failed, f"{id} did not find it: {report}"
        assert set(failed) == {id}, failed
        assert "TypeCheckError" not in failed[id] and "NameError" not in failed[id], failed[id]
        title = next(check.title for check in checks if check.id == id)
        record_property(KILL, [id, mutant, title])  # also passed on by xdist's workers

    return run


def pytest_terminal_summary(terminalreporter: Any) -> None:
    passed = terminalreporter.getreports("passed")
    kills = [value for report in passed for key, value in report.user_properties if key == KILL]
    if kills:
        terminalreporter.section("check -> mutant that it alone killed")
        for id, mutant, title in sorted(map(tuple, kills)):
            terminalreporter.write_line(f"{id}  {mutant:<28} {title}")
