"""How checks are declared, run and counted."""

from __future__ import annotations

import pytest
import torch

from hoigs.testing.checks import (
    CheckError,
    CheckList,
    Outcome,
    require_close,
    require_close_gradient,
    require_finite,
    run_checks,
)

CHECKS: CheckList[int] = CheckList("T")


def even(subject: int) -> str | None:
    return None if subject % 2 == 0 else "odd numbers have no half"


@CHECKS.check("T02")
def is_positive(subject: int) -> None:
    """It is positive."""
    if subject <= 0:
        raise CheckError(f"{subject} is not")


@CHECKS.check("T01", even)
def has_a_half(subject: int) -> None:
    """Half of it is a number.

    More words.
    """
    1 / subject


def test_a_report_counts_everything() -> None:
    assert [(check.id, check.title) for check in CHECKS] == [
        ("T01", "Half of it is a number"),
        ("T02", "It is positive"),
    ]
    report = run_checks(CHECKS, 3)
    assert [r.outcome for r in report.results] == [Outcome.SKIPPED, Outcome.PASSED]
    assert report.ok and report.run == 1
    assert "odd numbers have no half" in str(report) and "1 passed, 1 skipped" in str(report)
    report = run_checks(CHECKS, 0)
    assert not report.ok and report.count(Outcome.FAILED) == 2
    assert "ZeroDivisionError" in report.results[0].why and report.results[1].why == "0 is not"


def test_nothing_run_is_not_ok() -> None:
    assert not run_checks([CHECKS["T01"]], 3).ok
    assert not run_checks([], 3).ok


def test_expected_failures() -> None:
    report = run_checks(CHECKS, -2, {"T02": "below zero by design"})
    assert report.ok and report.count(Outcome.EXPECTED_FAILURE) == 1
    report = run_checks(CHECKS, 2, {"T02": "below zero by design"})
    assert not report.ok and report.count(Outcome.UNEXPECTED_PASS) == 1
    with pytest.raises(ValueError, match=r'"T03".*"T0[12]"'):
        run_checks(CHECKS, 2, {"T03": "no such"})


def test_ids_are_unique_and_of_one_shape() -> None:
    for id in ("T01", "X01", "T1"):
        with pytest.raises(ValueError, match=f'"{id}"'):
            CHECKS.check(id)
    with pytest.raises(KeyError, match="T09"):
        CHECKS["T09"]


def test_comparisons_say_where() -> None:
    a = torch.zeros(3, 4)
    b = a.clone()
    b[1, 2] = 0.5
    with pytest.raises(CheckError, match=r"x is 0.5, expected 0 .* at \[1, 2\]; 1 of 12"):
        require_close("x", b, a, atol=0.1)
    b[1, 2] = torch.nan
    with pytest.raises(CheckError, match=r"x is nan"):
        require_close("x", b, a, atol=0.1)
    with pytest.raises(CheckError, match=r"shape \[3\], expected \[4\]"):
        require_close("x", a[:, 0], a[0], atol=0.1)
    with pytest.raises(CheckError, match=r"x is nan at \[1, 2\]"):
        require_finite("x", b)
    with pytest.raises(CheckError, match=r"\bx\b"):
        require_close_gradient("x", None, a, 1e-3)
    with pytest.raises(CheckError, match=r"relative L2 error 1\.00e-01"):
        require_close_gradient("x", torch.full((4,), 1.1), torch.ones(4), 1e-3)
