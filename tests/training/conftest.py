"""The clip that baselines learn."""

from __future__ import annotations

import pytest

from hoigs.core.values.clip import Clip
from hoigs.runs.clip_source import read_clip


@pytest.fixture(scope="module")
def clip() -> Clip:
    """The built-in clip at its smallest, 64x64, generated once and cached."""
    from hoigs.plugins.bodies.anny import AnnyBody
    from hoigs.synthesis import SceneConfig, builtin_clip

    return read_clip(builtin_clip(AnnyBody(), SceneConfig.tiny()))
