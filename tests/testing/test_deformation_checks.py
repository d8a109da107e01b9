"""Every deformation check finds its mutant and no other; a correct one passes them all."""

from __future__ import annotations

import pytest
import torch
from deformation_mutants import CONFIGS, MUTANTS, Right, RightConfig

from hoigs.testing.checks import run_checks
from hoigs.testing.deformation import CHECKS, DeformationSubject


def test_the_right_one_passes() -> None:
    report = run_checks(CHECKS, DeformationSubject(Right, RightConfig()))
    assert report.ok and report.run >= 28, report


def test_every_check_has_its_mutant() -> None:
    assert set(MUTANTS) == {check.id for check in CHECKS}


@pytest.mark.parametrize("id", list(MUTANTS))
def test_a_check_kills_its_mutant_alone(id, kill) -> None:
    mutant = MUTANTS[id]
    subject = DeformationSubject(mutant, CONFIGS.get(id, RightConfig()))
    kill(CHECKS, subject, id, mutant.__name__)


class KeepsItsGraph(Right):
    """As a deformation that keeps its output for `regularizers`."""

    last: torch.Tensor | None = None

    def moved(self, canonical, moment):
        means = super().moved(canonical, moment)
        if self.training:
            self.last = means
        return means


class NamesIt(KeepsItsGraph):
    transient = {"last": None}  # noqa: RUF012


def test_what_a_pass_leaves_is_copied_only_where_it_is_named(kill) -> None:
    kill(CHECKS, DeformationSubject(KeepsItsGraph, RightConfig()), "D17", "KeepsItsGraph")
    assert run_checks(CHECKS, DeformationSubject(NamesIt, RightConfig())).ok
