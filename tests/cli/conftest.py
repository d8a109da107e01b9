"""The command line, called in this process: exit code, stdout and stderr of one `hoigs …`."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest


@dataclass(frozen=True)
class Outcome:
    code: int
    out: str
    err: str


@pytest.fixture
def hoigs(monkeypatch, capsys) -> Callable[..., Outcome]:
    """Run `hoigs ARGS…` and return what it said."""
    from hoigs.cli.main import main

    def run(*args: object) -> Outcome:
        monkeypatch.setattr(sys, "argv", ["hoigs", *map(str, args)])
        capsys.readouterr()
        try:
            main()
            code = 0
        except SystemExit as stop:
            code = int(stop.code or 0)
        captured = capsys.readouterr()
        return Outcome(code, captured.out, captured.err)

    return run


@pytest.fixture(scope="session")
def tiny_clip(tmp_path_factory) -> Path:
    """The built-in clip at its smallest."""
    from hoigs.plugins.bodies.anny import AnnyBody
    from hoigs.synthesis import SceneKnobs, builtin_clip

    made = builtin_clip(AnnyBody(), SceneKnobs.tiny())
    folder = tmp_path_factory.mktemp("clips") / "tiny"
    shutil.copytree(made, folder)
    return folder


@pytest.fixture
def clip_copy(tiny_clip, tmp_path) -> Path:
    """A copy that a test may break."""
    folder = tmp_path / "clip"
    shutil.copytree(tiny_clip, folder)
    return folder
