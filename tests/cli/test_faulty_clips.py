"""Clips with faults: refused, or trained on when asked; each fault is named in the run."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

SMALL = ("--set", "train.steps=4", "--set", "train.preview_every=2")
FEW = ("--set", "model.scene.points=500", "--set", "model.human.points=400",
       "--set", "model.object.points=100")  # fmt: skip


def spoil(clip) -> None:
    """Masks absent and all zero, an image gone, NaN depth."""
    (clip / "masks/object/00004.png").unlink()
    Image.fromarray(np.zeros((64, 64), np.uint8)).save(clip / "masks/human/00006.png")
    header = json.loads((clip / "clip.json").read_text())
    gone = header["split"]["train"][2]
    (clip / f"images/{gone:05d}.png").unlink()
    for path in clip.glob("depth/*.npz"):
        with np.load(path) as archive:
            depth = archive["depth"].copy()
        depth[:5] = np.nan
        np.savez(path, depth=depth)


@pytest.mark.slow
def test_training_goes_on_and_names_each_fault(hoigs, clip_copy, tmp_path):
    spoil(clip_copy)
    run = tmp_path / "run"
    refused = hoigs("train", clip_copy, "--spec", "hoigs", "--out", run, *SMALL)
    assert refused.code == 2 and "--allow-faults" in refused.err and not run.exists()
    done = hoigs("train", clip_copy, "--out", run, "--allow-faults", *SMALL, *FEW)
    assert done.code == 0, done.err
    for words in ("masks/object/00004.png", "are empty in frames 6", "images/", "NaN, infinite"):
        assert any(x.startswith("warning: ") and words in x for x in done.err.splitlines()), words
    named = {f["kind"] for f in json.loads((run / "provenance.json").read_text())["clip_faults"]}
    assert named >= {"missing-masks", "empty-masks", "missing-frames", "nan-depth"}
    page = (run / "report.html").read_text()
    assert "What is wrong with the clip" in page and "these pixels count as unknown" in page
    assert hoigs("eval", run, "--no-report").code == 0, "the run remembers what it was allowed"


@pytest.mark.slow
def test_scores_under_another_protocol_stand_beside_the_runs_own(hoigs, tiny_clip, tmp_path):
    run = tmp_path / "run"
    settings = ("--set", "train.steps=4", "--set", "train.preview_every=0", *FEW[:2])
    assert hoigs("train", tiny_clip, "--spec", "static", "--out", run, *settings).code == 0
    page = (run / "report.html").stat().st_mtime_ns
    assert "What is wrong" not in (run / "report.html").read_text()
    wrong = hoigs("eval", run, "--test-pose", "interpolatd")
    assert wrong.code == 2 and '"interpolated"' in wrong.err
    assert hoigs("eval", run, "--test-pose", "interpolated").code == 0
    fitted = hoigs("eval", run, "--test-pose", "fitted", "--fit-steps", "2")
    assert fitted.code == 0 and "FITTED TO TEST IMAGES" in fitted.out
    for name, pose in (("", "given"), ("-interpolated-given", "interpolated"),
                       ("-fitted-given", "fitted")):  # fmt: skip
        scores = json.loads((run / f"evaluation{name}.json").read_text())["scores"]
        assert {s["protocol"]["test_pose"] for s in scores} == {pose}
    assert (run / "report.html").stat().st_mtime_ns == page
