"""`hoigs`, `hoigs --help` and `hoigs plugins` are light."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest

PROBE = """
import sys
sys.argv = ["hoigs", *{args!r}]
from hoigs.cli.main import main
try:
    main()
except SystemExit as stop:
    assert not stop.code, stop.code
heavy = {{"torch", "warp", "kornia", "pycolmap", "scipy", "matplotlib"}} & set(sys.modules)
assert not heavy, heavy
"""


@pytest.mark.parametrize("args", [["--help"], ["plugins"], ["--version"], ["spec", "list"]])
def test_verbs_that_load_neither_torch_nor_warp(args):
    done = subprocess.run(
        [sys.executable, "-c", PROBE.format(args=args)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()


def test_importing_the_package_loads_neither():
    code = "import hoigs, sys; assert not {'torch', 'warp', 'numpy'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_every_public_name_exists():
    import hoigs

    for name in hoigs.__all__:
        assert getattr(hoigs, name) is not None


def commands():
    """Every command with its words: ("chart",), ("plugins", "new") …"""
    import typer

    from hoigs.cli.main import app

    def walk(command, words):
        yield words, command
        for name, child in getattr(command, "commands", {}).items():
            yield from walk(child, (*words, name))

    return list(walk(typer.main.get_command(app), ()))


@pytest.mark.parametrize(
    ("words", "command"), commands(), ids=lambda x: " ".join(x) if isinstance(x, tuple) else ""
)
def test_help_shows_all_that_is_written(hoigs, monkeypatch, words, command):
    """'hoigs[ray]' and runs/*.json are no markup."""
    monkeypatch.setenv("COLUMNS", "200")
    shown = "".join(c for c in hoigs(*words, "--help").out if c not in "│ \n")
    parameters = [p for p in command.params if not getattr(p, "hidden", False)]
    for text in (command.help, *(getattr(p, "help", "") for p in parameters)):
        for word in (text or "").replace("`", "").split():
            assert word in shown, word


def test_help_names_commands_that_exist():
    known = {words[0] for words, _ in commands() if words}
    for words, command in commands():
        parameters = [getattr(p, "help", "") for p in command.params]
        for text in (command.help, *parameters):
            for named in re.findall(r"`hoigs ([a-z-]+)", text or ""):
                assert named in known, (words, named)
