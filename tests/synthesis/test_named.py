"""builtin:NAME?setting=value."""

from __future__ import annotations

from pathlib import Path

import pytest

from hoigs.core.errors import ClipError
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.synthesis import SceneConfig, builtin_clip
from hoigs.synthesis.config import CLIPS
from hoigs.synthesis.named import clip_config, is_named, named_clip


def test_the_default_clip_is_lift_and_swing() -> None:
    assert clip_config("builtin:lift-and-swing") == SceneConfig()
    assert len({clip_config(f"builtin:{name}").digest() for name in CLIPS}) == len(CLIPS)


def test_settings_follow_a_question_mark() -> None:
    config = clip_config("builtin:carry?width=128&frames=24&camera.distance=3&seed=4")
    assert (config.width, config.height, config.frames, config.seed) == (128, 128, 24, 4)
    assert config.camera.distance == 3 and config.camera.arc_degrees == 30
    assert config.object.motion == "carried"
    assert clip_config("builtin:carry?width=128&height=64").height == 64
    assert clip_config("builtin:carry").frames == 80, "names stay as they are"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("builtin:cary", ['did you mean "builtin:carry"?', "builtin:throw-and-catch"]),
        ("builtin:", ["builtin:lift-and-swing"]),
        ("builtin:carry?widht=3", ["widht", 'did you mean "width"?']),
        ("builtin:carry?camera.distanc=3", ["camera.distanc", 'did you mean "distance"?']),
        ("builtin:carry?width=3", ["width", "greater than or equal to 16"]),
        ("builtin:carry?width", ["is not setting=value"]),
        ("builtin:jolted-push?object.hidden_share=0.5", ["hidden_share", '"carried"', '"pushed"']),
        ("builtin:carry?frames.of=3", ["frames has no settings"]),
        ("builtin:carry?frames=1000000000", ["frames: ", "100000"]),
        ("builtin:carry?width=100000000", ["width: ", "8192"]),
        ("builtin:carry?scene_points=1000000000", ["scene_points: ", "10000000"]),
    ],
)
def test_mistakes_are_told(name: str, words: list[str]) -> None:
    with pytest.raises(ClipError) as error:
        clip_config(name)
    for word in (name, *words):
        assert word in str(error.value)


def test_it_is_generated_once(
    body: AnnyBody, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOIGS_CACHE", str(tmp_path))
    name = "builtin:throw-and-catch?frames=4&width=16&held_out_views=0"
    folder = named_clip(name, body)
    assert folder == named_clip(name, body) == builtin_clip(body, clip_config(name))
    assert is_named(name) and is_named(Path(name)) and not is_named(folder)
