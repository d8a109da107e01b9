"""Each check of every kind but deformations and rasterizers fails its mutant, and only that."""

from __future__ import annotations

from typing import Any

import body_mutants
import decoder_mutants
import density_mutants
import exporter_mutants
import features_mutants
import interaction_mutants
import objective_mutants
import pytest
import reader_mutants

from hoigs.plugins.readers.clip import ClipFolderReader
from hoigs.testing import body, decoder, density, exporter, features, interaction, objective, reader
from hoigs.testing.checks import run_checks
from hoigs.testing.material import TinyBody

# kind: checks, subject, mutants, the correct component, settings
KINDS: dict[str, tuple[Any, ...]] = {
    "density": (
        density.CHECKS, density.DensitySubject, density_mutants.MUTANTS,
        density_mutants.RightDensity, density_mutants.RightDensityConfig(),
    ),
    "decoder": (
        decoder.CHECKS, decoder.DecoderSubject, decoder_mutants.MUTANTS,
        decoder_mutants.Right, decoder_mutants.RightConfig(),
    ),
    "body": (
        body.CHECKS, body.BodySubject, body_mutants.MUTANTS, TinyBody, body_mutants.TinyConfig(),
    ),
    "reader": (
        reader.CHECKS, reader.ReaderSubject, reader_mutants.MUTANTS, ClipFolderReader,
        ClipFolderReader.Config(),
    ),
    "exporter": (
        exporter.CHECKS, exporter.ExporterSubject, exporter_mutants.MUTANTS,
        exporter_mutants.Right, exporter_mutants.RightConfig(),
    ),
    "interaction": (
        interaction.CHECKS, interaction.InteractionSubject, interaction_mutants.MUTANTS,
        interaction_mutants.Right, interaction_mutants.RightConfig(),
    ),
    "objective": (
        objective.CHECKS, objective.ObjectiveSubject, objective_mutants.MUTANTS,
        objective_mutants.Right, objective_mutants.RightConfig(),
    ),
    "features": (
        features.CHECKS, features.FeaturesSubject, features_mutants.MUTANTS,
        features_mutants.Right, features_mutants.RightConfig(),
    ),
}  # fmt: skip
CASES = [(kind, id) for kind, (_, _, mutants, *_) in KINDS.items() for id in mutants]


@pytest.mark.parametrize("kind", KINDS)
def test_the_right_one_passes_and_every_check_has_a_mutant(kind) -> None:
    checks, subject, mutants, right, config = KINDS[kind]
    report = run_checks(checks, subject(right, config))
    assert report.ok and report.run == len(checks), report
    assert set(mutants) == {check.id for check in checks}


@pytest.mark.parametrize(("kind", "id"), CASES, ids=[id for _, id in CASES])
def test_a_check_kills_its_mutant_alone(kind, id, kill) -> None:
    checks, subject, mutants, _, config = KINDS[kind]
    kill(checks, subject(mutants[id], config), id, mutants[id].__name__)


def test_tokens_that_an_interaction_needs_are_declared() -> None:
    """One that gives a residual for each token, and does not say that it needs one for each."""
    made = interaction.InteractionSubject(
        interaction_mutants.OneForEachToken, interaction_mutants.RightConfig()
    )
    (failed,) = [r for r in run_checks(interaction.CHECKS, made).results if r.id == "I01"]
    assert "[5, 3]" in failed.why and "[7, 3]" in failed.why, failed.why
    assert 'tokens = {"object": "gaussian"}' in failed.why
