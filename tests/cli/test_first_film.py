"""benchmarks/first_film.py types what the README says, and its page shows what it measured."""

from __future__ import annotations

import json
import runpy
from pathlib import Path

ROOT = Path(__file__).parents[2]
SCRIPT = runpy.run_path(str(ROOT / "benchmarks" / "first_film.py"))


def test_its_commands_are_lines_of_the_readme():
    SCRIPT["require_in_readme"]()


def test_its_page_shows_its_results():
    found = json.loads(SCRIPT["RESULTS"].read_text())
    page = (ROOT / "docs" / "tutorials" / "first-film.md").read_text()
    assert SCRIPT["table"](found) in page
    assert found["date"] in page and found["code"] in page


def test_it_records_what_a_command_took(tmp_path):
    typed, commands = SCRIPT["typed"], SCRIPT["TYPED"]
    commands["hoigs --version"] = ("said",)
    row = typed("hoigs --version", tmp_path, [])
    assert row["typed"] == "hoigs --version" and 0 < row["seconds"] < 60
    assert row["processor_seconds"] > 0 and row["made_mb"] == {"said": 0.0}
    assert (tmp_path / "said" / "--version.txt").read_text().startswith("hoigs ")
