"""Clip folders that commands read."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def tiny_clip(tmp_path_factory) -> Path:
    """The built-in clip at its smallest."""
    from hoigs.plugins.bodies.anny import AnnyBody
    from hoigs.synthesis import SceneConfig, builtin_clip

    made = builtin_clip(AnnyBody(), SceneConfig.tiny())
    folder = tmp_path_factory.mktemp("clips") / "tiny"
    shutil.copytree(made, folder)
    return folder


@pytest.fixture
def clip_copy(tiny_clip, tmp_path) -> Path:
    """A copy that a test may break."""
    folder = tmp_path / "clip"
    shutil.copytree(tiny_clip, folder)
    return folder
