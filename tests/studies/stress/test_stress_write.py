"""The files of a study, from made-up verdicts."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

from made_up import MACHINE, PROTOCOL, SPECS, table
from PIL import Image

from hoigs.studies.stress.case import all_cases, choose_cases
from hoigs.studies.stress.report import as_json, as_markdown, write_stress
from hoigs.studies.stress.verdict import Verdict, in_short, rate_of


def test_all_files_are_written_whole(tmp_path: Path) -> None:
    paths = write_stress(table(), tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(p.name for p in paths)
    assert {p.suffix for p in paths} == {".json", ".md", ".png", ".svg"}
    for path in tmp_path.glob("*.png"):
        with Image.open(path) as image:
            assert min(image.size) > 1000
            assert len(image.convert("RGB").getcolors(1 << 20) or ()) > 50
    svg = (tmp_path / "stress-matrix.svg").read_text()
    for words in ("F01", "F51", "fast motion is smoothed over", "static-3dgs", MACHINE, "2030-01"):
        assert words in svg
    curves = (tmp_path / "stress-curves.svg").read_text()
    assert "degrees, end to end" in curves and MACHINE.partition(";")[0] in curves


def test_before_any_training_there_are_no_curves(tmp_path: Path) -> None:
    paths = write_stress(table(seeds=0, cases=choose_cases("F01")), tmp_path)
    assert not any("curves" in p.name for p in paths)


def test_every_number_has_its_machine_and_protocol() -> None:
    made = table()
    data = json.loads(as_json(made))
    assert len(data["cases"]) == len(all_cases())
    measured = [v for v in data["verdicts"] if v["seeds"]]
    assert measured and all(
        v["machines"] == [MACHINE] and v["protocol"] == list(PROTOCOL) for v in measured
    )
    assert len(data["verdicts"]) == len(all_cases()) * len(SPECS)
    one = next(v for v in data["verdicts"] if v["case"] == "F01" and v["spec"] == "d3dgs@matched")
    levels = one["seeds"][0]["levels"]
    assert one["seeds"][0]["broke_at"] == levels[-1]["value"] and not levels[-1]["stands"]
    assert levels[0]["values"]["iou_human"] == {"not_computed": "made up"}


def test_the_words_say_who_breaks_where_and_what_to_do() -> None:
    made = table()
    text = as_markdown(made)
    assert MACHINE in text and "2030-01-01" in text and PROTOCOL[0] in text
    (case,) = choose_cases("F01")
    verdict = made.at(case, "ex4dgs@matched")
    assert in_short(case, verdict) == f"breaks at {verdict.breaks_at:g}"
    assert rate_of(verdict) == "0/3"
    assert case.advice in text
    passed = Verdict(case.id, "hoigs", "pass")
    assert case.advice not in as_markdown(
        replace(made, verdicts=dict.fromkeys(made.verdicts, passed))
    )
