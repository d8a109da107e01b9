"""demo: what `--fast` changes; the run itself is `train`'s."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import hoigs.training.demo as demonstration
from hoigs.core.spec.schema import Spec
from hoigs.synthesis.named import clip_config


@pytest.mark.parametrize(
    ("options", "specs", "steps", "width"),
    [
        ({}, ["hoigs", "static"], 800, 256),
        ({"fast": True}, ["hoigs"], demonstration.FAST_STEPS, 128),
        ({"fast": True, "baseline": True, "steps": 7}, ["hoigs", "static"], 7, 128),
    ],
)
def test_what_is_trained_on_which_clip(
    options, specs, steps, width, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: dict[str, Any] = {}
    lines: list[str] = []

    def train(clip, *, options, **_):
        spec = Spec.load(options.spec, overrides=options.spec_settings())  # each knows its keys
        asked[options.spec] = spec

    monkeypatch.setattr(
        demonstration, "clip_folder", lambda clip: asked.update(c=clip_config(clip))
    )
    monkeypatch.setattr(demonstration, "train", train)
    demonstration.demo(out=tmp_path / "demo", report=lines.append, **options)
    assert asked.pop("c").width == width
    assert list(asked) == specs
    assert {spec.train.steps for spec in asked.values()} == {steps}
    points = asked["hoigs"].model["human"].points
    assert (points < 12_000) == ("fast" in options)
    assert any("32 frames of 128x128" in line for line in lines) == ("fast" in options)
