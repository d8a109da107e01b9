"""A spec and a clip in; scores, report and video out. On the smallest built-in clip."""

from __future__ import annotations

import json

import pytest
import torch

import hoigs as h
from hoigs.core.values.between import frame_numbers
from hoigs.viewing.films import playback_of
from hoigs.viewing.paths import film_path

SMALL = ("--set", "train.steps=60", "--set", "train.preview_every=30")
# a render of the default numbers takes 0.4 s, and an evaluation with its report makes 200 of them
FEW = ("--set", "model.scene.points=1000", "--set", "model.human.points=800",
       "--set", "model.object.points=200")  # fmt: skip


@pytest.mark.slow
def test_train_evaluate_and_render_from_python(hoigs, tiny_clip, tmp_path):
    """As the commands do it, with progress through callbacks and nothing on stdout."""
    run, lines, starts, steps, shares = tmp_path / "run", [], [], [], []
    done = h.train(
        tiny_clip, "hoigs", out=run, overrides=(SMALL + FEW)[1::2], rasterizer="warp", device="cpu",
        on_start=starts.append, on_step=steps.append, progress=lambda f, _: shares.append(f),
        report=lines.append,
    )  # fmt: skip
    assert done.path == run and starts == [done.session] and steps[-1].step == 60
    assert shares == sorted(shares) and shares[-1] == 1.0
    assert lines == [f"run: {run}", f"report: {run / 'report.html'}"]
    assert done.evaluated is not None and done.evaluated.report == run / "report.html"
    assert (run / "report.html").stat().st_size > 10_000
    records = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    curve = [record["psnr"]["test"] for record in records if "psnr" in record]
    assert curve[-1] > curve[0] + 3.0, "training must help"

    again = h.evaluate(run, report=False, device="cpu")
    assert again.report is None and again.scores == run / "evaluation.json"
    first = done.evaluated.evaluation.score("full", "psnr")
    assert again.evaluation.score("full", "psnr") == pytest.approx(first, abs=1e-3)

    loaded = h.open_run(run, device="cpu")
    for path in ("video", "orbit"):
        views = film_path(loaded.model, loaded.clip, path, *frame_numbers(loaded.clip))
        play = playback_of(loaded.model, views)
        for moment, camera in views[::3]:
            with torch.no_grad():
                wanted = loaded.model.render(moment, camera).color
            torch.testing.assert_close(play(moment, camera).color, wanted, atol=1e-5, rtol=0)

    film = h.render(run, entities=["human", "scene"], device="cpu")
    assert film.path == run / "renders" / "video.mp4" and film.frames == 12
    assert film.fps > 0 and film.mode == "cached" and "CUDA" in film.reason

    video = tmp_path / "orbit.mp4"
    drawn = hoigs("render", run, "--path", "orbit", "--out", video, "--device", "cpu")
    assert drawn.code == 0 and video.stat().st_size > 1000
    assert "12 frames of 64x64" in drawn.out and "frames/s" in drawn.out
    assert "CUDA graphs" not in drawn.out and "replaced" not in drawn.out
    beside = hoigs("render", run, "--compare", "--to", 1, "--device", "cpu")
    assert f"video: {run / 'renders' / 'video-compare.mp4'}\n" in beside.out
    again = hoigs("render", run, "--compare", "--to", 1, "--device", "cpu")
    assert "an earlier video of this name was replaced" in again.out
    wrong = hoigs("render", run, "--entities", "humn")
    assert wrong.code == 2 and '"human"' in wrong.err


@pytest.mark.slow
def test_resume_equals_the_unbroken_run(hoigs, tiny_clip, tmp_path, request):
    """Stopped at a checkpoint and resumed, a run ends with the same weights, bit for bit.

    On one thread: with more, the CPU's matrix products sum in an order that varies.
    """
    from safetensors.torch import load_file

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    request.addfinalizer(lambda: torch.set_num_threads(threads))

    settings = ("--set", "train.steps=8", "--set", "train.checkpoint_every=4", "--no-eval", *FEW)
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    assert hoigs("train", tiny_clip, "--out", whole, *settings).code == 0
    assert hoigs("train", tiny_clip, "--out", broken, *settings).code == 0
    for name in ("step_000008.safetensors", "step_000008.json"):
        (broken / "checkpoints" / name).unlink()
    assert hoigs("train", tiny_clip, "--out", broken, *settings, "--resume").code == 0
    ours = load_file(broken / "checkpoints" / "step_000008.safetensors")
    theirs = load_file(whole / "checkpoints" / "step_000008.safetensors")
    assert ours.keys() == theirs.keys()
    for key in ours:
        assert ours[key].equal(theirs[key]), key
    steps = [json.loads(x)["step"] for x in (broken / "metrics.jsonl").read_text().splitlines()]
    assert steps == sorted(set(steps))
