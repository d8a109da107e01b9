"""The README's Python runs as it stands, and links of the pages beside it lead somewhere."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import typer
from PIL import Image

import hoigs

README = Path(__file__).parents[1] / "README.md"


@pytest.mark.slow
def test_the_first_screen_runs(monkeypatch, tmp_path):
    from hoigs.synthesis import SceneConfig, builtin_clip

    # the smallest clip in place of the default one: the same code, seconds instead of a minute
    tiny = lambda body: builtin_clip(body, SceneConfig.tiny())  # noqa: E731
    monkeypatch.setattr(hoigs, "builtin_clip", tiny, raising=False)
    code = re.search(r"```python\n(.*?)```", README.read_text(), re.S)
    assert code is not None
    names: dict[str, object] = {}
    small = code[1].replace("clip[12]", "clip[2]").replace("steps=300", "steps=2")
    assert small.count("clip[2]") == 2 and "steps=2" in small
    monkeypatch.chdir(tmp_path)
    exec(compile(small, "README.md", "exec"), names)
    assert names["image"].shape == (64, 64, 3) and names["image"].isfinite().all()
    with Image.open("frame.png") as saved:
        assert saved.size == (64, 64) and np.asarray(saved).std() > 5


@pytest.mark.parametrize("page", sorted(README.parent.glob("*.md")), ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text()):
        assert "://" in target or (page.parent / target).exists(), target


BLOCKS = re.findall(r"^```(\w*)\n(.*?)^```$", README.read_text(), re.S | re.M)
COMMANDS = [
    line
    for language, block in BLOCKS
    for line in block.splitlines()
    if not language and line.startswith("hoigs ")
]


@pytest.mark.parametrize("line", COMMANDS)
def test_the_commands_have_these_options(line):
    from hoigs.cli.main import app

    _, name, *words = shlex.split(line, comments=True)
    command = typer.main.get_command(app).commands[name]
    command.make_parser(command.context_class(command)).parse_args(words)  # or NoSuchOption


def test_enough_commands_are_tested_and_what_they_need_is_installed():
    assert {"prepare", "train", "view"} <= {line.split()[1] for line in COMMANDS}
    assert "pip install '.[prepare,view]'" in README.read_text()
