"""Clips of one or two frames have none to test on: they train, and scores give the reason."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from recorded import Recorded
from small_clip import small_clip

from hoigs.core.clip_folder.write import write_clip
from hoigs.core.values.clip import uniform_test_split
from hoigs.core.values.moment import Moment


@pytest.mark.parametrize("frames", [1, 2])
def test_a_clip_without_test_frames(hoigs, tmp_path, frames):
    clip = small_clip()
    short = replace(
        clip, store=Recorded([clip.store.image(i) for i in range(frames)]),
        cameras=clip.cameras[:frames], moments=[Moment(float(i), i) for i in range(frames)],
        split=uniform_test_split(frames),
    )  # fmt: skip
    assert short.split["test"] == []
    write_clip(short, tmp_path / "clip")
    run = tmp_path / "run"
    outcome = hoigs("train", tmp_path / "clip", "--spec", "static", "--out", run,
                    "--device", "cpu", "--set", "train.steps=2")  # fmt: skip
    assert outcome.code == 0, outcome.err
    assert "not computed: the clip has no test frames" in outcome.out
    assert outcome.out.count("┏") == 1  # one table; the report has all
    found = json.loads((run / "evaluation.json").read_text())
    reasons = {json.dumps(score["value"]) for score in found["scores"]}
    assert reasons == {'{"not_computed": "the clip has no test frames"}'}
    assert "the clip has no test frames" in (run / "report.html").read_text()
    interpolated = hoigs("eval", run, "--test-camera", "interpolated", "--device", "cpu")
    assert interpolated.code == 0, interpolated.err
