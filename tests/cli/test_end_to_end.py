"""A spec and a clip in; scores, report and video out. On the smallest built-in clip."""

from __future__ import annotations

import json

import pytest

SMALL = ("--set", "train.steps=60", "--set", "train.preview_every=30")


@pytest.mark.slow
def test_train_eval_render(hoigs, tiny_clip, tmp_path):
    run = tmp_path / "run"
    done = hoigs("train", tiny_clip, "--spec", "hoigs", "--out", run, *SMALL)
    assert done.code == 0, done.err
    assert (run / "report.html").stat().st_size > 10_000
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    curve = [line["psnr"]["test"] for line in lines if "psnr" in line]
    assert curve[-1] > curve[0] + 3.0, "training must help"
    scored = hoigs("eval", run, "--no-report")
    assert scored.code == 0 and "psnr" in scored.out.lower()
    video = tmp_path / "orbit.mp4"
    assert hoigs("render", run, "--path", "orbit", "--out", video).code == 0
    assert video.stat().st_size > 1000
    wrong = hoigs("render", run, "--only", "humn")
    assert wrong.code == 2 and '"human"' in wrong.err


@pytest.mark.slow
def test_resume_equals_the_unbroken_run(hoigs, tiny_clip, tmp_path, request):
    """Stopped at a checkpoint and resumed, a run ends with the same weights, bit for bit.

    On one thread: with more, the CPU's matrix products sum in an order that varies.
    """
    import torch
    from safetensors.torch import load_file

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    request.addfinalizer(lambda: torch.set_num_threads(threads))

    settings = ("--set", "train.steps=24", "--set", "train.checkpoint_every=12", "--no-eval")
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    assert hoigs("train", tiny_clip, "--out", whole, *settings).code == 0
    assert hoigs("train", tiny_clip, "--out", broken, *settings).code == 0
    for name in ("step_000024.safetensors", "step_000024.json"):
        (broken / "checkpoints" / name).unlink()
    assert hoigs("train", tiny_clip, "--out", broken, *settings, "--resume").code == 0
    ours = load_file(broken / "checkpoints" / "step_000024.safetensors")
    theirs = load_file(whole / "checkpoints" / "step_000024.safetensors")
    assert ours.keys() == theirs.keys()
    for key in ours:
        assert ours[key].equal(theirs[key]), key
    steps = [json.loads(x)["step"] for x in (broken / "metrics.jsonl").read_text().splitlines()]
    assert steps == sorted(set(steps))
