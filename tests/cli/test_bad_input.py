"""Bad input: one clear message, exit code 2, and no partial run folder."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

SMALL = ("--set", "train.steps=4", "--set", "train.preview_every=0", "--no-eval")


def refused(outcome, run, *words: str) -> None:
    assert outcome.code == 2, outcome
    assert outcome.err.startswith("error: ")
    for word in words:
        assert word in outcome.err, outcome.err
    assert not run.exists()
    assert not list(run.parent.glob(f".{run.name}*"))


def test_unknown_spec_key(hoigs, tiny_clip, tmp_path):
    run = tmp_path / "run"
    spec = tmp_path / "my.yaml"
    spec.write_text("extends: hoigs\nmodel:\n  object:\n    deformation: {keyframe_stp: 2}\n")
    outcome = hoigs("train", tiny_clip, "--spec", spec, "--out", run)
    refused(outcome, run, "my.yaml:4:", "model.object.deformation.keyframe_stp", "keyframe_step")


def test_unknown_set_key(hoigs, tiny_clip, tmp_path):
    run = tmp_path / "run"
    outcome = hoigs("train", tiny_clip, "--out", run, "--set", "train.stepz=3")
    refused(outcome, run, "train.stepz", "steps")


def test_unknown_spec_name(hoigs, tiny_clip, tmp_path):
    run = tmp_path / "run"
    refused(hoigs("train", tiny_clip, "--spec", "hoig", "--out", run), run, "hoig", "hoigs")


def test_missing_masks(hoigs, clip_copy, tmp_path):
    run = tmp_path / "run"
    shutil.rmtree(clip_copy / "masks" / "object")
    (clip_copy / "masks" / "human" / "00003.png").unlink()
    outcome = hoigs("train", clip_copy, "--out", run)
    refused(outcome, run, "masks/object", "masks/human/00003.png")


def test_camera_count_unlike_frame_count(hoigs, clip_copy, tmp_path):
    run = tmp_path / "run"
    with np.load(clip_copy / "cameras.npz", allow_pickle=False) as file:
        arrays = {key: file[key] for key in file.files}
    frames = len(arrays["K"])
    np.savez(clip_copy / "cameras.npz", **{k: v[:-2] for k, v in arrays.items()})
    outcome = hoigs("train", clip_copy, "--out", run)
    refused(outcome, run, "cameras.npz", str(frames), str(frames - 2))


def test_nan_depth(hoigs, clip_copy, tmp_path):
    run = tmp_path / "run"
    path = clip_copy / "depth" / "00002.npz"
    with np.load(path, allow_pickle=False) as file:
        depth = file["depth"].astype(np.float32)
    depth[:4, :5] = np.nan
    np.savez(path, depth=depth)
    refused(hoigs("train", clip_copy, "--out", run), run, "depth/00002.npz", "20", "NaN")


def test_empty_video(hoigs, tmp_path):
    source, out = tmp_path / "source", tmp_path / "clip"
    source.mkdir()
    (source / "video.mp4").write_bytes(b"")
    outcome = hoigs("prepare", source, "--out", out)
    assert outcome.code == 2
    assert "video.mp4" in outcome.err
    assert not out.exists()


def test_not_a_clip(hoigs, tmp_path):
    run = tmp_path / "run"
    (tmp_path / "nothing").mkdir()
    refused(hoigs("train", tmp_path / "nothing", "--out", run), run, "clip.json")


@pytest.mark.slow
def test_checkpoint_from_another_spec(hoigs, tiny_clip, tmp_path):
    run = tmp_path / "run"
    assert hoigs("train", tiny_clip, "--spec", "static", "--out", run, *SMALL).code == 0
    other = tmp_path / "other"
    assert hoigs("train", tiny_clip, "--spec", "hoigs", "--out", other, *SMALL).code == 0
    for file in (run / "checkpoints").iterdir():
        shutil.copy(file, other / "checkpoints" / file.name)
    outcome = hoigs("eval", other)
    assert outcome.code == 2
    assert "'static'" in outcome.err and "spec.yaml" in outcome.err


@pytest.mark.slow
def test_an_existing_run_is_not_overwritten_unasked(hoigs, tiny_clip, tmp_path):
    run = tmp_path / "run"
    assert hoigs("train", tiny_clip, "--spec", "static", "--out", run, *SMALL).code == 0
    before = (run / "metrics.jsonl").read_bytes()
    outcome = hoigs("train", tiny_clip, "--spec", "static", "--out", run, *SMALL)
    assert outcome.code == 2 and "--overwrite" in outcome.err
    assert (run / "metrics.jsonl").read_bytes() == before


def test_the_demo_looks_at_both_of_its_folders_first(hoigs, tmp_path):
    kept = tmp_path / "demo-static"
    kept.mkdir()
    (kept / "scores.txt").write_text("mine")
    refused(hoigs("demo", "--out", tmp_path / "demo"), tmp_path / "demo", "demo-static")
    assert (kept / "scores.txt").read_text() == "mine"


def test_damaged_checkpoint(hoigs, tiny_clip, tmp_path):
    run = tmp_path / "run"
    assert hoigs("train", tiny_clip, "--spec", "static", "--out", run, *SMALL).code == 0
    newest = max((run / "checkpoints").glob("*.safetensors"))
    newest.write_bytes(newest.read_bytes()[:100])
    outcome = hoigs("eval", run)
    assert outcome.code == 2 and newest.name in outcome.err
    meta = newest.with_suffix(".json")
    meta.write_text(json.dumps({"format": "other"}))
    assert "format 'other'" in hoigs("eval", run).err


def test_what_is_no_clip_folder(hoigs, tmp_path):
    run, video = tmp_path / "run", tmp_path / "few.mp4"
    video.touch()
    refused(hoigs("train", video, "--out", run), run, f"`hoigs prepare {video} --out clips/few`")


def test_a_run_within_its_clip(hoigs, tiny_clip, monkeypatch):
    words = f"lies inside of {tiny_clip}, which it is made from"
    out = tiny_clip / "runs" / "x"
    refused(hoigs("train", tiny_clip, "--out", out), tiny_clip / "runs", words)
    monkeypatch.chdir(tiny_clip)
    refused(hoigs("train", ".", "--spec", "static"), tiny_clip / "runs", "lies inside of .,")


@pytest.mark.parametrize(
    ("words", "who"),
    [
        (("train", ""), "CLIP"), (("refine", "", "--out", "x"), "CLIP"), (("eval", ""), "RUN"),
        (("view", ""), "RUN|CLIP or RUN2"), (("prepare", "", "--out", "x"), "SOURCE"),
        (("train", "clip", "--out", ""), "--out"), (("export", "run", "--out="), "--out"),
        (("render", "run", "--path", "", "--fps", "3"), "--path"), (("spec", "check", ""), "an"),
    ],
)  # fmt: skip
def test_an_empty_word_is_not_the_current_folder(hoigs, words, who):
    outcome = hoigs(*words)
    assert outcome.code == 2 and outcome.err.startswith(f"error: {who}"), outcome.err
    assert "is an empty text" in outcome.err
