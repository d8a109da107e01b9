"""A cap of "auto" depends on the pixels of a frame."""

from __future__ import annotations

from dataclasses import replace

import pytest

from hoigs.core.interfaces.context import BuildContext
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.plugins.density.adc import AdaptiveDensity, AdaptiveDensityConfig
from hoigs.plugins.density.children import LEAST, MOST, resolve_cap
from hoigs.plugins.density.mcmc import McmcDensity, McmcDensityConfig
from hoigs.runs.clip_source import read_clip
from hoigs.synthesis import SceneConfig, builtin_clip


@pytest.fixture(scope="module")
def clip():
    return read_clip(builtin_clip(AnnyBody(), SceneConfig.tiny()))


@pytest.mark.parametrize(
    ("width", "height", "cap"), [(368, 480, 100_684), (64, 64, LEAST), (4000, 3000, MOST)]
)
def test_it_goes_by_the_pixels_within_bounds(clip, width, height, cap):
    clip = replace(clip, cameras=[c.resized(width, height) for c in clip.cameras])
    context = BuildContext(entity="scene", clip=clip)
    assert resolve_cap("auto", clip) == cap
    assert AdaptiveDensity.from_config(AdaptiveDensityConfig(cap="auto"), context).cap == cap
    assert McmcDensity.from_config(McmcDensityConfig(cap="auto"), context).cap == cap


def test_a_scene_that_shows_more_gets_more(clip):
    assert resolve_cap("auto+14000", clip) == LEAST + 14_000
    assert AdaptiveDensityConfig(cap="auto+14000").cap == "auto+14000"
    with pytest.raises(ValueError, match="auto"):
        AdaptiveDensityConfig(cap="many")


def test_a_scene_that_needs_less_gets_a_part(clip):
    assert resolve_cap("auto/2", clip) == LEAST // 2
    assert resolve_cap("auto/4+500", clip) == LEAST // 4 + 500
    assert AdaptiveDensityConfig(cap="auto/2").cap == "auto/2"
    with pytest.raises(ValueError, match="auto"):
        AdaptiveDensityConfig(cap="auto/0")


def test_a_number_stays():
    assert resolve_cap(123, None) == 123


def test_without_a_clip_there_is_nothing_to_count():
    with pytest.raises(ValueError, match="set a number"):
        resolve_cap("auto", None)
