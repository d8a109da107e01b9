"""Fragments are bullets, and collecting them loses nothing."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest
import yaml

import hoigs

ROOT = Path(__file__).parents[2]


@pytest.fixture
def collect(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "scripts")
    from changelog import collect

    yield collect
    del sys.modules["changelog"]


@pytest.fixture
def project(tmp_path):
    (tmp_path / "changelog.d").mkdir()
    (tmp_path / "changelog.d" / "README.md").write_text("# how\n")
    (tmp_path / "CHANGELOG.md").write_text("# Changelog\n\n## Unreleased\n\n- Old.\n")
    return tmp_path


def test_fragments_move_to_the_top(collect, project):
    (project / "changelog.d" / "b.md").write_text("- Second.\n")
    (project / "changelog.d" / "a.md").write_text("- First,\n  on two lines.\n")
    assert collect(project) == 2
    assert (project / "CHANGELOG.md").read_text() == (
        "# Changelog\n\n## Unreleased\n\n- First,\n  on two lines.\n- Second.\n- Old.\n"
    )
    assert [p.name for p in (project / "changelog.d").iterdir()] == ["README.md"]
    assert collect(project) == 0


def test_what_is_no_list_changes_nothing(collect, project):
    (project / "changelog.d" / "a.md").write_text("- Fine.\n")
    (project / "changelog.d" / "b.md").write_text("no bullet\n")
    with pytest.raises(ValueError, match=r"b\.md: expected bullets"):
        collect(project)
    assert (project / "changelog.d" / "a.md").exists()
    assert "Fine" not in (project / "CHANGELOG.md").read_text()


def test_the_fragments_here_are_fine(collect, project):
    for path in (ROOT / "changelog.d").glob("*.md"):
        (project / "changelog.d" / path.name).write_text(path.read_text())
    collect(project)


def test_the_version_is_the_changelogs_and_the_citations():
    newest = re.search(r"^## (\d+\.\d+\.\d+)", (ROOT / "CHANGELOG.md").read_text(), re.M)
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"]
    assert newest is not None and newest[1] == cited == hoigs.__version__
