"""Signals: the step is finished, a checkpoint written, and the next command printed."""

from __future__ import annotations

import contextlib
import os
import signal
import sys

import pytest
from small_clip import small_clip

from hoigs.cli.common import Display
from hoigs.core.clip_folder.write import write_clip
from hoigs.core.errors import HoigsError

SMALL = ["--device", "cpu", "--set", "train.steps=9", "--set", "train.preview_every=0",
         "--set", "train.log_every=1"]  # fmt: skip


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clips") / "small"
    small = small_clip()
    small.split["test"].append(small.split["train"].pop())
    write_clip(small, folder)
    return folder


@pytest.fixture(autouse=True)
def a_closed_terminal_is_heard():
    """Though `nohup` has this process ignore SIGHUP; SIGINT is that of all tests."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_what_the_parent_ignores_stays_ignored(hoigs, clip, tmp_path, monkeypatch, number):
    monkeypatch.setattr(Display, "step", lambda _, report: signal.raise_signal(number))
    run, before = tmp_path / "run", signal.signal(number, signal.SIG_IGN)
    try:
        done = hoigs("train", clip, "--spec", "static", "--out", run, *SMALL, "--no-eval")
        assert signal.getsignal(number) is signal.SIG_IGN
    finally:
        signal.signal(number, before)
    assert done.code == 0, done.err
    assert (run / "checkpoints" / "step_000009.json").is_file()


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)]
)
def test_a_stopped_training_keeps_its_steps(hoigs, clip, tmp_path, monkeypatch, number, code):
    run, before = tmp_path / "run", signal.getsignal(number)
    monkeypatch.setattr(
        Display, "step", lambda _, report: report.step == 3 and signal.raise_signal(number)
    )
    stopped = hoigs("train", clip, "--spec", "static", "--out", run, *SMALL)
    assert stopped.code == code, stopped.err
    assert "stopped at step 3 of 9" in stopped.err
    assert f"hoigs train --resume --out {run}" in stopped.err
    assert [p.name for p in (run / "checkpoints").glob("*.json")] == ["step_000003.json"]
    assert signal.getsignal(number) is before
    assert hoigs("train", "--resume", "--out", run, "--no-eval", "--device", "cpu").code == 0
    assert (run / "checkpoints" / "step_000009.json").is_file()


def test_a_reader_that_left_does_not_end_a_command(monkeypatch):
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as left:
        monkeypatch.setattr(sys, "stdout", left)
        Display().line("nobody reads this")
        Display().line("nor this")


def test_a_second_signal_stops_within_the_step(hoigs, clip, tmp_path, monkeypatch):
    def twice(_, report):
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(Display, "step", twice)
    run = tmp_path / "run"
    stopped = hoigs("train", clip, "--spec", "static", "--out", run, *SMALL)
    assert (stopped.code, stopped.err.splitlines()[-1]) == (143, "stopped")
    assert not list((run / "checkpoints").iterdir())


@pytest.mark.parametrize(
    ("command", "work"),
    [
        (["batch", "rows.csv", "--out", "out"], "batch.batch.batch"),
        (
            ["study", "compare", "x", "--specs", "static", "--out", "out"],
            "compare.run.run_comparison",
        ),
        (["study", "stress", "--specs", "static", "--out", "out"], "stress.run.run_stress"),
    ],
    ids=lambda x: x[0] if isinstance(x, list) else "",
)
def test_a_study_that_is_stopped_says_by_what(hoigs, tmp_path, monkeypatch, command, work):
    def stop(*_: object, **__: object) -> None:
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(f"hoigs.studies.{work}", stop)
    stopped = hoigs(*command)
    assert (stopped.code, stopped.err) == (143, "stopped\n")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_within_the_import_of_an_extension(hoigs, monkeypatch, number, code):
    """Extensions make an ImportError of it."""

    def fails() -> None:
        try:
            signal.raise_signal(number)
        except KeyboardInterrupt as stop:
            raise ImportError("initialization failed") from stop

    monkeypatch.setattr("hoigs.studies.doctor.doctor", fails)
    stopped = hoigs("doctor")
    assert (stopped.code, stopped.err) == (code, "stopped\n")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_that_compiled_code_turns_into_an_error_of_its_own(
    hoigs, monkeypatch, number, code
):
    """As safetensors does while it opens a file, which would be called damaged."""

    def fails() -> None:
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(number)
        raise HoigsError("damaged")

    monkeypatch.setattr("hoigs.studies.doctor.doctor", fails)
    stopped = hoigs("doctor")
    assert (stopped.code, stopped.err) == (code, "stopped\n")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_while_options_are_read(hoigs, monkeypatch, number, code):
    def stop(*_: object, **__: object) -> None:
        signal.raise_signal(number)

    monkeypatch.setattr("hoigs.cli.failures.GuardedGroup.make_context", stop)
    stopped = hoigs("doctor")
    assert (stopped.code, stopped.err) == (code, "stopped\n")


def test_a_trained_run_that_is_not_yet_scored(hoigs, clip, tmp_path, monkeypatch):
    def stop(*_: object, **__: object) -> None:
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("hoigs.training.train.evaluate_run", stop)
    stopped = hoigs("train", clip, "--spec", "static", "--out", tmp_path / "run", *SMALL)
    assert stopped.code == 130 and f"hoigs eval {tmp_path / 'run'}" in stopped.err
