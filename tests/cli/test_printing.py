"""What commands print: nothing is cut, repeated or empty, and no escape sequence comes through."""

from __future__ import annotations

import subprocess
import sys

import pytest

from hoigs.cli.common import print_table
from hoigs.cli.make import _announce
from hoigs.preparation.estimates.plan import Choice, EstimatorPlan

WIDE = [f"a column with a long title, number {i}" for i in range(9)]


def test_wide_tables_are_not_cut(capsys: pytest.CaptureFixture[str]) -> None:
    print_table("wide", WIDE, [[f"a{i}-" + 30 * "x" for i in range(9)]])
    shown = capsys.readouterr().out
    assert "…" not in shown
    assert all(title in shown for title in WIDE) and all(
        f"a{i}-{30 * 'x'}" in shown for i in range(9)
    )


def test_narrow_terminals_break_words(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setenv("FORCE_COLOR", "1")  # rich takes this for a terminal
    print_table("narrow", ["name", "value"], [[50 * "n", 30 * "v"]])
    shown = capsys.readouterr().out
    assert "…" not in shown and shown.count("n") >= 50 and shown.count("v") >= 30


def test_names_and_notes_are_not_taken_for_commands(capsys: pytest.CaptureFixture[str]) -> None:
    odd = "\x1b]0;title\x07\x1b[31mred"
    print_table(odd, [odd], [[odd]], [odd, "pip install 'hoigs[usd]'"])
    shown = capsys.readouterr().out
    assert "\x1b" not in shown and "\x07" not in shown
    assert shown.count("red") == 4 and "hoigs[usd]" in shown


def test_a_table_without_rows_is_its_notes(capsys: pytest.CaptureFixture[str]) -> None:
    print_table("geometry", ["measure", "mean"], [], ["all of it: not computed: no truth"])
    assert capsys.readouterr().out.split("\n") == [
        "geometry", "all of it: not computed: no truth", "",
    ]  # fmt: skip


def test_warp_starts_without_a_word() -> None:
    code = "import hoigs.synthesis.generate, hoigs.rasterizers.warp"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "" and done.stderr == ""


def test_texts_start_at_the_left_and_numbers_end_at_the_right(
    capsys: pytest.CaptureFixture[str],
) -> None:
    print_table("t", ["what", "why", "time"], [["a", "short", "9 s"], ["b", "rather long", "10 s"]])
    row = next(line for line in capsys.readouterr().out.splitlines() if "short" in line)
    assert [cell[1:-1] for cell in row[1:-1].split("│")] == ["a   ", "short      ", " 9 s"]


@pytest.mark.parametrize("terminal", [True, False])
def test_a_narrow_table_breaks_lines_between_words(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, terminal: bool
) -> None:
    monkeypatch.setenv("COLUMNS", "44" if terminal else "200")
    if terminal:
        monkeypatch.setenv("FORCE_COLOR", "1")
    rows = [["masks", "object-tracker", "no file of it lies beside the video", "12 s"]]
    print_table("t", ["what", "from", "why", "time"], rows, widest=None if terminal else 44)
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("│")]
    columns = [[line.split("│")[k].strip() for line in lines] for k in range(1, 5)]
    assert [" ".join(column).strip() for column in columns] == rows[0]
    assert len(lines) > 1 and all(len(line) <= 44 for line in lines)


@pytest.mark.parametrize(
    ("counted", "words"), [(True, "for 7 frames,"), (False, "for at most 7 frames, by the video's")]
)
def test_a_plan_says_where_its_number_of_frames_is_from(
    capsys: pytest.CaptureFixture[str], counted: bool, words: str
) -> None:
    """A video that is cut off has fewer than its header says."""
    choice = Choice("depth", "none", "no network", 0.0)
    _announce(EstimatorPlan({"depth": choice}, 7, counted=counted))
    assert words in capsys.readouterr().out
