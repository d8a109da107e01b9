"""What newcomers mistype: the message names what they mean."""

from __future__ import annotations

import re
import signal

import pytest

from hoigs.cli.main import app
from hoigs.cli.mistyped import COMMANDS


def said(outcome) -> str:
    """The message without its frame and its line breaks."""
    assert outcome.code == 2, outcome
    return " ".join(outcome.err.replace("│", " ").split())


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (["train", "clip", "--steps", "300"], "--set train.steps=VALUE"),
        (["train", "clip", "--width", "640"], "--set train.width=VALUE"),
        (["train", "clip", "--stepz", "300"], "--set train.steps=VALUE"),
        (["prepare", "my.mp4", "--out", "x", "--object-size", "0.1"], "--set object_size=VALUE"),
        (["prepare", "my.mp4", "--out", "x", "--widht", "640"], "--width"),
        (["train", "clip", "--budgit", "20m"], "--budget"),
        (["render", "run", "--pth", "orbit"], "--path"),
    ],
    ids=lambda x: " ".join(x) if isinstance(x, list) else x,
)
def test_an_option_that_is_a_setting_is_named_as_one(hoigs, words, meant):
    message = said(hoigs(*words))
    assert f"No such option: {words[-2]}" in message and meant in message
    assert ("--set " in meant) == ("setting" in message)


@pytest.mark.parametrize("word", COMMANDS)
def test_a_word_for_a_command_names_it(hoigs, word):
    import typer

    commands = typer.main.get_command(app).commands
    assert word not in commands
    message = said(hoigs(word, "runs/mine"))
    assert message == f"error: {word}: no such command; {COMMANDS[word]}"
    named = re.findall(r"`hoigs ([\w-]+)", COMMANDS[word])
    assert named and set(named) <= set(commands)


def test_a_folder_of_a_like_name_is_proposed(hoigs, tiny_clip, tmp_path):
    (tmp_path / "mine").symlink_to(tiny_clip)
    (tmp_path / "mien.prepare").mkdir()
    assert f'did you mean "{tmp_path / "mine"}"?' in said(hoigs("train", tmp_path / "mien"))
    assert "did you mean" not in said(hoigs("train", tmp_path / "another"))
    run = tmp_path / "jugle"
    (tmp_path / "juggle").mkdir()
    assert "did you mean" not in said(hoigs("render", run))
    (tmp_path / "juggle" / "spec.yaml").touch()
    message = said(hoigs("render", run))
    assert f'{run}: no such folder; did you mean "{tmp_path / "juggle"}"?' in message
    assert f"`hoigs train CLIP --out {run}`" in message
    assert "did you mean" not in said(hoigs("render", tmp_path / "absent" / "juggle"))


def test_a_clip_that_is_not_trained_yet(hoigs, tiny_clip):
    message = said(hoigs("render", tiny_clip))
    assert "a clip, not yet a run" in message
    assert f"`hoigs train {tiny_clip} --out runs/{tiny_clip.name}`" in message


def test_a_stopped_prepare_says_that_it_continues(hoigs, tmp_path, monkeypatch):
    out = tmp_path / "mine"

    def stop(*_: object, **__: object) -> None:
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("hoigs.preparation.prepare.prepare", stop)
    stopped = hoigs("prepare", "my.mp4", "--out", out)
    assert (stopped.code, stopped.err) == (130, "stopped\n")
    (tmp_path / "mine.prepare").mkdir()
    stopped = hoigs("prepare", "my.mp4", "--out", out)
    assert stopped.code == 130
    assert f"the same command continues: {tmp_path / 'mine.prepare'}" in stopped.err
