"""Check, CheckList and Report: declaring, running and counting conformance checks."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from hoigs.core.errors import did_you_mean

if TYPE_CHECKING:
    from torch import Tensor

Subject = TypeVar("Subject")
Component = TypeVar("Component")
Need = Callable[[Any], str | None]  # the reason why a check does not apply; None when it does


class CheckError(AssertionError):
    """A failed check; the message contains the expected and the actual value."""


@dataclass(frozen=True)
class ComponentSubject(Generic[Component]):
    """A component class with its settings: what the checks of its kind run on."""

    cls: type[Component]
    config: Any

    def __str__(self) -> str:
        return self.cls.__name__


@dataclass(frozen=True)
class Check(Generic[Subject]):
    """One check of a plugin.

    Attributes:
        id: stable, for example "R07"; the id of a removed check is not used again.
        title: one line.
        function: raises CheckError, or what the plugin raises; may return a remark.
        needs: conditions on what the subject declares, under which the check applies.
    """

    id: str
    title: str
    function: Callable[[Subject], str | None]
    needs: tuple[Need, ...] = ()

    def missing(self, subject: Subject) -> str | None:
        """The reason why the check does not apply to the subject, or None."""
        return next((why for need in self.needs if (why := need(subject)) is not None), None)

    def run(self, subject: Subject) -> str | None:
        """A remark, or None; raises when the subject fails."""
        return self.function(subject)


class CheckList(Generic[Subject]):
    """The checks of one interface, ordered by id.

    Args:
        letter: first letter of the ids.
    """

    def __init__(self, letter: str) -> None:
        self.letter = letter
        self._checks: dict[str, Check[Subject]] = {}

    def check(
        self, id: str, *needs: Need
    ) -> Callable[[Callable[[Subject], str | None]], Callable[[Subject], str | None]]:
        """Decorator that adds a check; the first line of the docstring is its title."""
        if not re.fullmatch(rf"{self.letter}\d\d", id) or id in self._checks:
            raise ValueError(f'check id "{id}": expected {self.letter} and two digits, used once')

        def add(function: Callable[[Subject], str | None]) -> Callable[[Subject], str | None]:
            title = (function.__doc__ or function.__name__).strip().partition("\n")[0].rstrip(".")
            self._checks[id] = Check(id, title, function, needs)
            return function

        return add

    def __iter__(self) -> Iterator[Check[Subject]]:
        return iter(sorted(self._checks.values(), key=lambda check: check.id))

    def __len__(self) -> int:
        return len(self._checks)

    def __getitem__(self, id: str) -> Check[Subject]:
        if id not in self._checks:
            raise KeyError(f'no check "{id}"{did_you_mean(id, self._checks)}')
        return self._checks[id]


class Outcome(StrEnum):
    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "skipped"
    EXPECTED_FAILURE = "expected failure"
    UNEXPECTED_PASS = "unexpected pass"


@dataclass(frozen=True)
class Result:
    """The outcome of one check; `why` is the reason, or a remark on a check that passed."""

    id: str
    title: str
    outcome: Outcome
    why: str = ""


@dataclass(frozen=True)
class Report:
    """The results of a list of checks on one subject."""

    subject: str
    results: tuple[Result, ...]

    def count(self, outcome: Outcome) -> int:
        return sum(result.outcome is outcome for result in self.results)

    @property
    def run(self) -> int:
        return len(self.results) - self.count(Outcome.SKIPPED)

    @property
    def ok(self) -> bool:
        """Some check was run, none failed, and no expected failure passed."""
        bad = self.count(Outcome.FAILED) + self.count(Outcome.UNEXPECTED_PASS)
        return self.run > 0 and bad == 0

    def __str__(self) -> str:
        counts = ", ".join(f"{self.count(o)} {o}" for o in Outcome if self.count(o))
        lines = [f"{self.subject}: {self.run} checks run ({counts or 'none'})"]
        lines += [
            f"  {r.id} {r.outcome}: {r.title}" + (f"\n      {r.why}" if r.why else "")
            for r in self.results
            if r.why or r.outcome is not Outcome.PASSED
        ]
        return "\n".join(lines)

    def as_dict(self) -> dict[str, Any]:
        """For JSON: subject, ok, counts by outcome, and every result."""
        counts = {str(o): self.count(o) for o in Outcome}
        results = [
            {"id": r.id, "title": r.title, "outcome": str(r.outcome), "why": r.why}
            for r in self.results
        ]
        counts["run"] = self.run
        return {"subject": self.subject, "ok": self.ok, "counts": counts, "results": results}


def run_checks(
    checks: Iterable[Check[Subject]],
    subject: Subject,
    expected_failures: Mapping[str, str] | None = None,
) -> Report:
    """Run every check that applies to the subject.

    Args:
        expected_failures: id of a check -> why this subject is known to fail it. The check runs
            all the same, and is an error when it passes.

    Raises:
        ValueError: `expected_failures` names a check that is not among `checks`.
    """
    checks, expected = list(checks), dict(expected_failures or {})
    refuse_unknown(expected, [check.id for check in checks])
    results = tuple(run_check(check, subject, expected.get(check.id)) for check in checks)
    return Report(str(subject), results)


def refuse_unknown(expected_failures: Iterable[str], ids: Iterable[str]) -> None:
    """Raise ValueError when an expected failure is not among these ids."""
    ids = list(ids)
    for id in expected_failures:
        if id not in ids:
            raise ValueError(f'expected_failures: no check "{id}"{did_you_mean(id, ids)}')


def run_check(check: Check[Subject], subject: Subject, expected: str | None = None) -> Result:
    """Run one check; `expected` is the reason why it should fail, if it should."""
    missing = check.missing(subject)
    if missing is not None:
        return Result(check.id, check.title, Outcome.SKIPPED, missing)
    try:
        remark = check.run(subject)
    except Exception as error:
        text = str(error) if isinstance(error, CheckError) else f"{type(error).__name__}: {error}"
        if expected is None:
            return Result(check.id, check.title, Outcome.FAILED, text)
        return Result(check.id, check.title, Outcome.EXPECTED_FAILURE, expected)
    if expected is None:
        return Result(check.id, check.title, Outcome.PASSED, remark or "")
    return Result(check.id, check.title, Outcome.UNEXPECTED_PASS, f"expected to fail: {expected}")


# Comparisons whose errors name what differs, by how much and where.


def require(condition: Any, message: str) -> None:
    """Raise CheckError with `message` unless `condition` (a bool or a tensor of one) holds."""
    if not bool(condition):
        raise CheckError(message)


def require_close(
    what: str, actual: Tensor | float, expected: Tensor | float, *, atol: float, rtol: float = 0.0
) -> None:
    """|actual - expected| <= atol + rtol |expected| everywhere, in float64; NaN never is."""
    import torch

    a, b = (torch.as_tensor(x).detach().double().cpu() for x in (actual, expected))
    if a.shape != b.shape:
        raise CheckError(f"{what} has shape {list(a.shape)}, expected {list(b.shape)}")
    excess = (a - b).abs() - (atol + rtol * b.abs())
    good = excess <= 0
    if bool(good.all()):
        return
    worst = int(torch.where(good, -torch.inf, excess.nan_to_num(torch.inf)).argmax())
    place = [int(i) for i in torch.unravel_index(torch.tensor(worst), a.shape)]
    raise CheckError(
        f"{what} is {a.flatten()[worst]:.6g}, expected {b.flatten()[worst]:.6g} within "
        f"{atol:g} + {rtol:g} of it"
        + (f", at {place}; {int((~good).sum())} of {a.numel()} entries are off" if place else "")
    )


def require_zero(what: str, value: Tensor | None) -> None:
    """Every entry is exactly zero; None, an absent gradient, counts as zeros."""
    if value is not None and bool((value != 0).any()):
        place = (value != 0).nonzero()[0].tolist()
        raise CheckError(f"{what} is {float(value[tuple(place)]):g} at {place}, expected zeros")


def require_finite(what: str, value: Tensor) -> None:
    import torch

    if not bool(torch.isfinite(value).all()):
        place = (~torch.isfinite(value)).nonzero()[0].tolist()
        raise CheckError(f"{what} is {float(value[tuple(place)])} at {place}, expected numbers")


def require_close_gradient(
    what: str, actual: Tensor | None, expected: Tensor, error: float
) -> None:
    """|actual - expected| <= error |expected|, as vectors."""
    if actual is None:
        raise CheckError(f"no gradient reached {what}")
    require_finite(f"gradient of {what}", actual)
    a, b = actual.double().cpu().flatten(), expected.double().cpu().flatten()
    off = float((a - b).norm() / b.norm())
    if not off <= error:
        cosine = float(a @ b / (a.norm() * b.norm()))
        raise CheckError(
            f"gradient of {what}: relative L2 error {off:.2e}, expected at most {error:g} "
            f"(cosine {cosine:.7f})"
        )
