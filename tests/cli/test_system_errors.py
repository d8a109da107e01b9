"""What the system refuses is a sentence and exit code 2, and leaves nothing."""

from __future__ import annotations

import errno
import shutil
import sys

import pytest

from hoigs.cli.failures import message_of
from hoigs.core.system.files import printable, written_whole
from hoigs.runs.run_folder import RunFolder

SMALL = ["--device", "cpu", "--set", "train.steps=2", "--set", "train.preview_every=0", "--no-eval"]


@pytest.mark.parametrize("place", ["file", "file/run", "dangling", "dangling/run", "x" * 300,
                                   "new/" + "x" * 251])  # fmt: skip
@pytest.mark.parametrize("command", ["train", "demo"])
def test_an_out_that_cannot_be(hoigs, tiny_clip, tmp_path, command, place):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    before = sorted(tmp_path.iterdir())
    clip = [tiny_clip] if command == "train" else []
    settings = SMALL if command == "train" else []
    outcome = hoigs(command, *clip, "--out", tmp_path / place, *settings)
    assert outcome.code == 2 and outcome.err.startswith("error: "), outcome.err
    assert "Traceback" not in outcome.err and place[:9] in outcome.err
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="a Linux path")
def test_a_place_where_nothing_can_be_made(hoigs, tiny_clip, tmp_path):
    outcome = hoigs("train", tiny_clip, "--out", "/proc/hoigs-run", *SMALL)
    assert outcome.code == 2 and "cannot be made in /proc" in outcome.err


def test_more_points_than_memory(hoigs, tiny_clip, tmp_path):
    outcome = hoigs("train", tiny_clip, "--spec", "static", "--out", tmp_path / "run", *SMALL,
                    "--set", "model.human.points=1000000000000",
                    "--set", "model.human.deformation.use=deformation:skinned-body")  # fmt: skip
    assert outcome.code == 2 and "Traceback" not in outcome.err, outcome.err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("at", ["checkpoint", "folder"])
def test_a_full_disk(hoigs, tiny_clip, tmp_path, monkeypatch, at):
    full = OSError(errno.ENOSPC, "No space left on device", str(tmp_path / "x"))

    def fail(*_: object, **__: object) -> None:
        raise full

    if at == "checkpoint":
        monkeypatch.setattr("hoigs.runs.checkpoint.save_file", fail)
    else:
        monkeypatch.setattr("hoigs.runs.run_folder.put_in_place", fail)
    outcome = hoigs("train", tiny_clip, "--spec", "static", "--out", tmp_path / "run", *SMALL)
    assert outcome.code == 2 and "the disk is full" in outcome.err, outcome.err
    assert not list(tmp_path.iterdir())


def test_a_disk_without_room_for_a_checkpoint(hoigs, tiny_clip, tmp_path, monkeypatch):
    """It is found out before the work."""
    usage = shutil.disk_usage
    small = usage(tmp_path)._replace(free=10_000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: small)
    outcome = hoigs("train", tiny_clip, "--spec", "static", "--out", tmp_path / "a/run", *SMALL)
    assert outcome.code == 2 and "has 0.0 MB left; make room" in outcome.err, outcome.err
    assert "training static" not in outcome.out and not list(tmp_path.iterdir())


def test_a_disk_that_is_full_after_a_checkpoint(hoigs, tiny_clip, tmp_path, monkeypatch):
    """The run stays, at its last checkpoint."""
    log = RunFolder.log

    def fail(run: RunFolder, record: dict[str, object]) -> None:
        if record["step"] == 2:
            raise OSError(errno.ENOSPC, "No space left on device", str(run.metrics))
        log(run, record)

    monkeypatch.setattr(RunFolder, "log", fail)
    every = ["--set", "train.checkpoint_every=1", "--set", "train.log_every=1"]
    run = tmp_path / "run"
    outcome = hoigs("train", tiny_clip, "--spec", "static", "--out", run, *SMALL, *every)
    assert outcome.code == 2 and "metrics.jsonl: the disk is full" in outcome.err, outcome.err
    assert [p.name for p in (run / "checkpoints").glob("*.json")] == ["step_000001.json"]


def test_a_mistake_in_hoigs_keeps_its_traceback():
    assert message_of(IndexError("17")) is None
    assert message_of(RuntimeError("size mismatch")) is None
    assert "not enough memory" in message_of(RuntimeError("CUDA out of memory. Tried …"))
    assert "not enough memory" in message_of(MemoryError())
    assert printable("a\x1b[31mb\nc") == "a�[31mb\nc"


def test_a_write_that_finds_the_disk_full_names_its_file(tmp_path):
    """`write()` does not know which file it writes; the message said "a file"."""
    with pytest.raises(OSError) as caught, written_whole(tmp_path / "scores.json"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert caught.value.filename == str(tmp_path / "scores.json")
    assert not list(tmp_path.iterdir())
