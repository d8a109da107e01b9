"""Every python and console block of tutorials and how-tos runs, page by page, in a fresh folder.

Comments before a block, which readers do not see:

    <!-- skip: why -->                    it is not run
    <!-- small: "text" is "less" -->      in the test, "less" is run in place of "text"
    <!-- file: name.py -->                it is written to that file, not run
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
PAGES = sorted([*(DOCS / "tutorials").glob("*.md"), *(DOCS / "howto").glob("*.md")])
BLOCK = re.compile(r"((?:^<!--[^\n]*-->\n)*)^```(\w*)\n(.*?)^```$", re.M | re.S)
# SceneConfig.tiny() by name: the clip that other tests use
TINY = (
    "builtin:lift-and-swing?frames=12&width=64&height=64&fps=3&edge_samples=4&held_out_views=3"
    "&test_frames=3&scene_points=2000&object_points=300"
)
# what a reader's pip would fetch is here already, and nothing is installed for good
PIP = "pip install -q --no-index --no-deps --no-build-isolation --target site ./"


@dataclass
class Block:
    """One fenced block, with what its comments say."""

    language: str
    text: str
    line: int
    skip: str = ""
    file: str = ""
    small: list[tuple[str, str]] = field(default_factory=list)

    def shortened(self) -> str:
        """The text with small settings in place of a reader's."""
        text = self.text
        for long, short in self.small:
            assert long in text, f"line {self.line}: the block has no {long!r} to make smaller"
            text = text.replace(long, short)
        return text.replace("TINY", TINY)


def blocks_of(page: Path) -> list[Block]:
    text, found = page.read_text(), []
    for match in BLOCK.finditer(text):
        notes, language, body = match.groups()
        block = Block(language, body, text[: match.start()].count("\n") + 1)
        for note in re.findall(r"<!-- (.*?) -->", notes):
            kind, _, value = note.partition(": ")
            if kind == "small":
                long, short = value.split(" is ")
                block.small.append((long.strip('"'), short.strip('"')))
            else:
                assert kind in ("skip", "file") and value, f"{page.name}:{block.line}: {note}"
                setattr(block, kind, value)
        found.append(block)
    return found


@pytest.mark.slow
@pytest.mark.usefixtures("few_renders")
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_blocks_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"__name__": "__main__"}
    for block in blocks_of(page):
        if block.skip or block.language not in ("python", "console", "json", "csv"):
            continue
        where = f"{page.name}:{block.line}"
        if block.file:
            Path(block.file).write_text(block.shortened())
        elif block.language == "python":
            exec(compile(block.shortened(), where, "exec"), names)
        else:
            for line in block.shortened().splitlines():
                assert line.startswith("$ "), f"{where}: a console block shows commands alone"
                run_command(line.removeprefix("$ "), where)


def run_command(line: str, where: str) -> None:
    """`hoigs …` in this process unless a package of the page's own is installed; others beside."""
    words = shlex.split(line)
    if words[0] == "hoigs" and not Path("site").is_dir():
        assert run_hoigs(words) == 0, f"{where}: {line}"
        return
    if words[0] == "PIP":
        words = shlex.split(PIP + words[1])
    head = {"hoigs": ["-m", "hoigs"], "pytest": ["-m", "pytest"], "pip": ["-m", "pip"]}
    done = subprocess.run(
        [sys.executable, *head[words[0]], *words[1:]],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": "site"},
    )
    assert done.returncode == 0, f"{where}: {line}\n{done.stdout}{done.stderr}"


def run_hoigs(words: list[str]) -> int:
    """The exit code of a command."""
    from hoigs.cli.main import main

    before, sys.argv = sys.argv, words
    try:
        main()
    except SystemExit as stop:
        return int(stop.code or 0)
    finally:
        sys.argv = before
    return 0


def test_every_page_has_blocks_that_run_and_reasons_for_the_rest():
    assert len(PAGES) >= 10
    runnable = {
        page.stem: sum(b.language in ("python", "console") and not b.skip for b in blocks_of(page))
        for page in PAGES
    }
    of_videos = {
        "masks", "cameras", "people", "other-bodies", "video-files", "check-clip", "first-film",
    }  # fmt: skip
    assert all(runnable[name] for name in runnable if name not in of_videos), runnable
    assert sum(runnable.values()) >= 20


def test_yaml_blocks_are_specs():
    from hoigs.core.spec.loader import load_yaml

    for page in PAGES:
        for block in blocks_of(page):
            if block.language == "yaml":
                assert "extends" in load_yaml(block.text, f"{page.name}:{block.line}").data


def test_comments_do_what_they_say(tmp_path, monkeypatch):
    page = tmp_path / "page.md"
    page.write_text(
        "<!-- skip: no -->\n```python\n1 / 0\n```\n"
        '<!-- small: "7" is "2" -->\n```python\nx = 7\n```\n'
    )
    first, second = blocks_of(page)
    assert first.skip == "no" and second.shortened() == "x = 2\n" and second.line == 5
    page.write_text("```python\nassert False, 'told'\n```\n")
    with pytest.raises(AssertionError, match="told"):
        test_blocks_run(page, tmp_path, monkeypatch)
    page.write_text("```console\n$ hoigs spec check nothing.yaml\n```\n")
    with (
        pytest.raises(AssertionError, match=r"page.md:1: hoigs spec"),
        contextlib.redirect_stderr(io.StringIO()),
    ):
        test_blocks_run(page, tmp_path, monkeypatch)
