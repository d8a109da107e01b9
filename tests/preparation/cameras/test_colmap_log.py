"""COLMAP's log."""

from __future__ import annotations

import pytest

from hoigs.preparation.cameras.turning_cameras import quiet_colmap

pycolmap = pytest.importorskip("pycolmap")


def test_an_attempt_that_fails_prints_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    pycolmap.logging.error("outside")
    before = pycolmap.logging.minloglevel
    with quiet_colmap():
        pycolmap.logging.error("Failed to create any sparse model")
    assert pycolmap.logging.minloglevel == before
    said = capfd.readouterr().err
    assert "outside" in said and "sparse model" not in said
