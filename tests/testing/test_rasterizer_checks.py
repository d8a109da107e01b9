"""The rasterizer checks can fail: each finds its mutant; and the right rasterizer passes."""

from __future__ import annotations

import pytest
import torch
from rasterizer_mutants import MUTANTS

from hoigs.testing.checks import Outcome, run_checks
from hoigs.testing.rasterizer import CHECKS, RasterizerSubject


def test_every_check_has_its_mutant() -> None:
    assert set(MUTANTS) == {check.id for check in CHECKS}


@pytest.mark.parametrize("id", list(MUTANTS))
def test_a_check_finds_its_mutant(id: str) -> None:
    subject = RasterizerSubject(MUTANTS[id](), torch.device("cpu"))
    (result,) = run_checks([CHECKS[id]], subject).results
    assert result.outcome is Outcome.FAILED, result
    assert "TypeCheckError" not in result.why
