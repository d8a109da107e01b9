"""`hoigs estimators`: what is installed, and what is not."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from hoigs.cli.main import app
from hoigs.core.errors import HoigsError
from hoigs.core.registry.registry import environment_named


def test_environments_are_listed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOIGS_CACHE", str(tmp_path / "cache"))
    done = CliRunner().invoke(app, ["estimators", "list"])
    assert done.exit_code == 0 and "mediapipe" in done.output and "not installed" in done.output
    done = CliRunner().invoke(app, ["estimators", "remove", "mediapipe"])
    assert "was not installed" in done.output and not (tmp_path / "cache").exists()
    with pytest.raises(HoigsError, match=r'no environment .*did you mean "mediapipe"'):
        environment_named("mediapip")
