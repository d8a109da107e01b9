"""-q, -v, --json, short options and completion."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest
import typer

from hoigs.cli.common import Display, Talk, print_table, say, with_json
from hoigs.cli.main import app


@pytest.fixture
def talk(monkeypatch):
    """Sets how much is said, for one test."""
    return lambda **values: [monkeypatch.setattr(Talk, k, v) for k, v in values.items()]


@with_json
def scores() -> None:
    say("working")
    print_table("scores", ("spec", "PSNR"), [("hoigs", "31.50"), ("static", "not computed")], ["a"])


def test_json_is_all_of_stdout(capsys):
    scores(as_json=True)
    said = capsys.readouterr()
    (table,) = json.loads(said.out)
    assert table == {
        "title": "scores",
        "rows": [{"spec": "hoigs", "PSNR": 31.5}, {"spec": "static", "PSNR": "not computed"}],
        "notes": ["a"],
    }
    assert said.err == "working\n" and Talk.tables is None
    scores(as_json=False)
    assert "31.50" in capsys.readouterr().out


def test_a_failure_prints_no_json(capsys):
    @with_json
    def fails() -> None:
        raise ValueError

    with pytest.raises(ValueError):
        fails(as_json=True)
    assert capsys.readouterr().out == "" and Talk.tables is None


def test_quiet_leaves_out_the_work_and_keeps_the_results(capsys, talk):
    talk(quiet=True)
    with Display() as show:
        show.line("run: a")
        show.fraction(0.5, "half")
    print_table("scores", ("spec",), [("hoigs",)])
    said = capsys.readouterr()
    assert "run: a" not in said.out and "hoigs" in said.out and said.err == ""


def test_verbose_has_a_line_for_each_step(capsys, talk):
    talk(verbose=True)
    with Display() as show:
        for done, text in ((0.1, "masks"), (0.2, "masks"), (0.5, "body")):
            show.fraction(done, text)
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[-1] for line in lines] == ["masks", "body"] and "50 %" in lines[1]


def test_without_a_terminal_a_long_work_says_where_it_is(capsys, talk, monkeypatch):
    talk()
    now = [0.0]
    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    with Display() as show:
        for seconds, done, text in ((1, 0.1, "masks"), (25, 0.3, "body"), (30, 0.4, "body")):
            now[0] = seconds
            show.fraction(done, text)
    said = capsys.readouterr()
    assert said.out == "" and said.err.split() == ["25.0", "s", "30", "%", "body"]


def test_both_may_stand_behind_the_command(hoigs, tmp_path):
    failed = hoigs("eval", str(tmp_path / "none"))
    assert failed.code == 2 and "Traceback" not in failed.err
    with pytest.raises(Exception, match="none"):  # a traceback, as of a fault in hoigs
        hoigs("eval", str(tmp_path / "none"), "-v")
    assert hoigs("spec", "list", "-q").code == 0 and Talk.quiet and not Talk.verbose
    hoigs("spec", "list")
    assert not Talk.quiet


def commands(command, words=()):
    for name, child in getattr(command, "commands", {}).items():
        yield from commands(child, (*words, name))
    yield words, command


COMMANDS = dict(commands(typer.main.get_command(app)))
TABLES = ("demo", "prepare", "train", "eval", "doctor", "plugins", "study needs", "estimators list")


@pytest.mark.parametrize("words", TABLES)
def test_what_prints_tables_prints_json(words):
    names = {name for p in COMMANDS[tuple(words.split())].params for name in p.opts}
    assert "--json" in names


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_letters_mean_one_thing(words):
    letters = {"--out": "-o", "--format": "-f", "--width": "-w", "--device": "-d", "--jobs": "-j"}
    seen = [name for p in COMMANDS[words].params for name in p.opts]
    assert len(seen) == len(set(seen))
    for long, short in letters.items():
        assert (long in seen) == (short in seen)


def test_the_shell_completes_commands():
    words = {"_HOIGS_COMPLETE": "complete_bash", "COMP_WORDS": "hoigs exp", "COMP_CWORD": "1"}
    code = "import sys; sys.argv = ['hoigs']; from hoigs.cli.main import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | words, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.stdout.split() == ["export"], done.stderr


def test_help_of_export_lists_the_formats(hoigs):
    from hoigs.core.registry.registry import default_registry

    shown = hoigs("export", "--help").out
    for key in default_registry().keys("exporter"):
        assert f" {key.partition(':')[2]}: " in shown
