"""--overwrite replaces what hoigs made, in whatever state, and nothing that others put there."""

from __future__ import annotations

from pathlib import Path

import pytest

SMALL = ["--device", "cpu", "--set", "train.steps=2", "--set", "train.preview_every=0",
         "--set", "model.scene.points=200"]  # fmt: skip


@pytest.fixture
def train(hoigs, tiny_clip, tmp_path):
    """`hoigs train … --overwrite` into run/."""

    def again(*more: object, clip: Path = tiny_clip, out: Path = tmp_path / "run"):
        return hoigs("train", clip, "--spec", "static", "--out", out, *SMALL, "--overwrite", *more)

    return again


@pytest.mark.slow
def test_a_run_with_all_that_hoigs_writes_into_it(hoigs, train, tmp_path):
    run, compact = tmp_path / "run", tmp_path / "run-compact"
    assert train().code == 0
    assert hoigs("eval", run, "--test-camera", "interpolated", "--device", "cpu").code == 0
    for path in ("video", "bullet-time"):
        assert hoigs("render", run, "--path", path, "--device", "cpu").code == 0
    exports = [("ply", ()), ("tracks", ()), ("ply", ("--out", run / "exports" / "box.ply"))]
    for name, more in exports:
        assert hoigs("export", run, "--format", name, *more, "--device", "cpu").code == 0
    for _ in range(2):
        assert hoigs("compress", run, "--overwrite", "--device", "cpu").code == 0
    assert hoigs("eval", compact, "--device", "cpu").code == 0
    assert train("--no-eval").code == 0
    assert not any((run / name).exists() for name in ("renders", "exports"))
    assert not (run / "report.html").exists()
    outcome = hoigs("compress", run, "--out", run, "--overwrite", "--device", "cpu")
    assert outcome.code == 2 and "is or holds the input" in outcome.err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run", "run-compact"]


@pytest.mark.slow
def test_a_run_that_was_stopped(train, tmp_path):
    assert train("--no-eval").code == 0
    checkpoints = tmp_path / "run" / "checkpoints"
    for file in checkpoints.iterdir():
        file.unlink()
    (checkpoints / "step_000002.safetensors.part").write_bytes(b"half")
    (tmp_path / "run" / ".evaluation.json.part").write_bytes(b"half")
    assert train("--no-eval").code == 0


@pytest.mark.slow
@pytest.mark.parametrize("place", ["notes.txt", "checkpoints/mine.pt", "photos/cat.png"])
def test_a_run_that_holds_something_else(train, tmp_path, place):
    assert train("--no-eval").code == 0
    mine = tmp_path / "run" / place
    mine.parent.mkdir(exist_ok=True)
    mine.write_text("mine")
    outcome = train("--no-eval")
    assert outcome.code == 2 and place.removesuffix("cat.png") in outcome.err
    assert mine.read_text() == "mine"
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


def test_other_folders_with_a_spec_in_them(hoigs, train, clip_copy, tmp_path):
    project = tmp_path / "project"
    project.mkdir()
    (project / "spec.yaml").write_text("name: mine")
    (project / "thesis.tex").write_text("mine")
    for outcome in (
        train(out=project),
        hoigs("demo", "--out", project, "--overwrite"),
        hoigs("study", "needs", clip_copy, "--out", project, "--overwrite", "--device", "cpu"),
    ):
        assert outcome.code == 2 and "not a complete" in outcome.err
    assert (project / "thesis.tex").read_text() == "mine"
    assert (project / "spec.yaml").read_text() == "name: mine"


def test_the_clip_its_parent_the_working_directory_and_links(
    train, clip_copy, tmp_path, monkeypatch
):
    (tmp_path / "link").symlink_to(clip_copy)
    monkeypatch.chdir(tmp_path)
    for out, why in (
        (clip_copy, "is or holds the input"),
        (tmp_path, "is the working directory or holds it"),
        (Path(), "is the working directory or holds it"),
        (tmp_path / "link", "is a symbolic link"),
    ):
        outcome = train(clip=clip_copy, out=out)
        assert outcome.code == 2 and why in outcome.err
    assert (clip_copy / "clip.json").is_file()
