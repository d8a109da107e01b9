"""Every rasterizer check finds its mutant, and no other does; the right one passes them all."""

from __future__ import annotations

import pytest
import torch
from rasterizer_mutants import MUTANTS
from remembering import Remembering

from hoigs.testing.checks import Outcome, run_checks
from hoigs.testing.rasterizer import CHECKS, RasterizerSubject

CPU = torch.device("cpu")


def test_the_right_one_passes() -> None:
    report = run_checks(CHECKS, RasterizerSubject(Remembering(), CPU))
    skipped = [r.id for r in report.results if r.outcome is Outcome.SKIPPED]
    assert report.ok and skipped == ["R72", "R86"], report


def test_every_check_has_its_mutant() -> None:
    assert set(MUTANTS) == {check.id for check in CHECKS}


@pytest.mark.parametrize("id", list(MUTANTS))
def test_a_check_kills_its_mutant_alone(id, kill) -> None:
    name, mutant = MUTANTS[id]
    torch.manual_seed(0)
    kill(CHECKS, RasterizerSubject(mutant(), CPU), id, name)
