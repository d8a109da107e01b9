"""Manifests: defaults and overrides, and messages with file, line and key."""

from __future__ import annotations

import csv
import json
import os
import random
from pathlib import Path

import pytest

from hoigs.core.errors import HoigsError
from hoigs.studies.batch import manifest
from hoigs.studies.batch.folder import BATCH, BatchFolder, stages_of
from hoigs.studies.batch.manifest import ManifestError, each_row
from hoigs.studies.batch.summary import write_summary


def test_yaml_and_csv_give_the_same_rows(tmp_path):
    (tmp_path / "one.mp4").touch()
    (tmp_path / "two.mp4").touch()
    (tmp_path / "m.yaml").write_text(
        "defaults: {spec: static, set: {train.steps: 5}}\n"
        "rows:\n  - video: one.mp4\n  - {video: two.mp4, name: zwei, set: [train.steps=7]}\n"
    )
    (tmp_path / "m.csv").write_text(
        "video,name,spec,set\none.mp4,,static,train.steps=5\ntwo.mp4,zwei,static,train.steps=7\n"
    )
    rows = list(each_row(tmp_path / "m.yaml", {"spec": "hoigs", "device": "cpu"}))
    assert [(r.name, r.spec, r.set, r.device) for r in rows] == [
        ("one", "static", ("train.steps=5",), "cpu"),
        ("zwei", "static", ("train.steps=7",), "cpu"),
    ]
    assert list(each_row(tmp_path / "m.csv", {"device": "cpu"})) == rows


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rows:\n  - video: oen.mp4\n", r'm\.yaml:2:\S* video: .*"one.mp4"'),
        ("rows:\n  - vidoe: one.mp4\n", r'm\.yaml:2:\S* vidoe: .*"video"'),
        ("row:\n  - video: one.mp4\n", r'm\.yaml:1:\S* row: .*"rows"'),
        ("rows:\n  - {video: one.mp4, clip: one.mp4}\n", r"m\.yaml:2.*video.*clip"),
        ("rows:\n  - video: one.mp4\n    auto: maybe\n", r"m\.yaml:3:\S* auto: .*'maybe'"),
        ("rows:\n  - clip: one.mp4\n    train: {chunck: 16}\n", r'm\.yaml:3:\S* train: .*"chunk"'),
        ("rows:\n  - clip: one.mp4\n    train: {chunk: many}\n", r"m\.yaml:3:\S* train: .*chunk"),
        ("rows:\n  - clip: one.mp4\n    train: {plugins: a.py}\n", r"m\.yaml:3:.* plugins"),
        ("rows:\n  - video: one.mp4\n    name: ../x\n", r"m\.yaml:3:\S* name: "),
        (
            "rows:\n  - video: one.mp4\n  - video: one.mp4\n",
            r'm\.yaml:3\S* name: "one" .*m\.yaml:2',
        ),
        ("rows: []\n", r"m\.yaml"),
    ],
)
def test_mistakes_are_found_where_they_are(tmp_path, text, message):
    (tmp_path / "one.mp4").touch()
    (tmp_path / "m.yaml").write_text(text)
    with pytest.raises(ManifestError, match=message):
        list(each_row(tmp_path / "m.yaml"))


def test_a_row_has_the_options_of_a_training(tmp_path):
    (tmp_path / "m.yaml").write_text(
        "rows:\n  - clip: builtin:carry\n    auto: true\n    set: {train.steps: 5}\n"
        "    train: {chunk: 16, allow_faults: true}\n"
    )
    (row,) = list(each_row(tmp_path / "m.yaml"))
    stage = next(s for s in stages_of(row, tmp_path) if s.name == "train")
    options = [*stage.command]
    for words in (["--chunk", "16"], ["--allow-faults"], ["--set", "train.steps=5"], ["--no-eval"],
                  ["--auto"], ["--out", str(tmp_path / "run")]):  # fmt: skip
        place = options.index(words[0])
        assert options[place : place + len(words)] == words


def test_rows_are_checked_before_a_folder_is_made(tmp_path):
    (tmp_path / "m.csv").write_text("clip,name\nbuiltin:carry,a\nbuiltin:carry,A\n")
    with pytest.raises(ManifestError, match=r'm.csv:3: name: "A" .*m.csv:2'):
        BatchFolder.begin(tmp_path / "out", each_row(tmp_path / "m.csv"))
    assert not list(tmp_path.glob("out/*"))
    (tmp_path / "m.csv").write_text("clip,name\ngone,a\n")
    with pytest.raises(ManifestError, match="gone"):
        BatchFolder.begin(tmp_path / "out2", each_row(tmp_path / "m.csv"))
    assert not (tmp_path / "out2").exists()


def test_names_with_equal_hashes_are_two_rows(tmp_path, monkeypatch):
    monkeypatch.setattr(manifest, "hash", lambda name: 0, raising=False)
    (tmp_path / "m.csv").write_text("clip,name\nbuiltin:carry,a\nbuiltin:carry,b\n")
    assert [row.name for row in each_row(tmp_path / "m.csv")] == ["a", "b"]


@pytest.mark.parametrize(("many", "place"), [(3, "rows/[0-9a-f][0-9a-f]"), (4, "rows")])
def test_folders_of_many_rows_fan_out_and_stay_where_they_are(tmp_path, many, place):
    lines = [f"builtin:carry,row{i}" for i in range(3)]
    (tmp_path / "m.csv").write_text("\n".join(["clip,name", *lines]))
    made = BatchFolder.begin(tmp_path / "out", each_row(tmp_path / "m.csv"), many)
    for row in made.rows():
        made.of(row).mkdir()
    assert len(list((tmp_path / "out").glob(f"{place}/row?"))) == 3
    (tmp_path / "m.csv").write_text("\n".join(["clip,name", *lines, "builtin:carry,row3"]))
    again = BatchFolder.begin(tmp_path / "out", each_row(tmp_path / "m.csv"), 1)
    assert again == made == BatchFolder.open(tmp_path / "out")
    assert [row.name for row in again.rows()] == ["row0", "row1", "row2", "row3"]
    write_summary(again)
    found = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert [item["name"] for item in found] == ["row0", "row1", "row2", "row3"]
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == sorted(
        [BATCH, "rows", "summary.csv", "summary.html", "summary.json"]
    )


@pytest.mark.parametrize("many", [1, 9])
def test_a_damaged_list_is_written_again_where_the_rows_are(tmp_path, many):
    (tmp_path / "m.csv").write_text("clip,name\nbuiltin:carry,a\n")
    made = BatchFolder.begin(tmp_path / "out", each_row(tmp_path / "m.csv"), many)
    (tmp_path / "out" / BATCH).write_text("{")
    assert BatchFolder.begin(tmp_path / "out", each_row(tmp_path / "m.csv"), 5) == made
    assert [row.name for row in BatchFolder.open(tmp_path / "out").rows()] == ["a"]


NASTY = (
    "/home/me/thesis", "..", ".", "../../x", "a/b", "a\\b", "a\0b", "a\nb", "a\x1b[2Jb", "\ud800",
    "-rf", "--overwrite", "", " ", "x" * 300, "x" * 200_000, "C:\\x", "s3://x/../..", "é",
    "http://[", 0, -1, 10**400, 1e400, float("nan"), None, True, [], {}, [[[]]], {"a": {"b": 1}},
)  # fmt: skip


@pytest.mark.parametrize("value", ["../x", "/home/me/thesis", "..", "a/b", "", "ply\n"])
@pytest.mark.parametrize("key", ["export", "name"])
def test_names_that_leave_the_batch_are_refused_when_read_and_when_read_back(tmp_path, key, value):
    (tmp_path / "m.yaml").write_text("rows:\n- {name: a, clip: 'builtin:carry', export: [ply]}\n")
    made = BatchFolder.begin(tmp_path / "out", each_row(tmp_path / "m.yaml"))
    row = {"name": "a", "clip": "builtin:carry", key: [value] if key == "export" else value}
    if row["name"]:  # without one, a manifest's row is named after its clip
        (tmp_path / "m.yaml").write_text(json.dumps({"rows": [row]}))
        with pytest.raises(ManifestError, match=rf"m\.yaml:1:\d+: {key}: ") as caught:
            list(each_row(tmp_path / "m.yaml"))
        assert repr(value) in str(caught.value)
    (made.path / BATCH).write_text(f'{{"fan_out": false}}\n{json.dumps(row)}\n')
    with pytest.raises(HoigsError, match=f"{BATCH}:2"):
        list(made.rows())


def test_what_is_no_csv_and_no_file_is_named(tmp_path):
    (tmp_path / "m.csv").write_text(f"clip,spec\nbuiltin:carry,a\nbuiltin:carry,{'s' * 200_000}\n")
    with pytest.raises(ManifestError, match=r"m\.csv:3: .*131072"):
        list(each_row(tmp_path / "m.csv"))
    os.mkfifo(tmp_path / "m.yaml")
    with pytest.raises(ManifestError, match=r"m\.yaml: .*FIFO"):
        list(each_row(tmp_path / "m.yaml"))


@pytest.mark.parametrize(
    "text", ["[" * 100_000, "[]", '{"failed": {"stage": 3}}', '{"done": {"a": {}}}']
)
def test_a_damaged_record_costs_its_row_alone(tmp_path, text):
    (tmp_path / "m.csv").write_text("clip,name\nbuiltin:carry,a\nbuiltin:carry,b\n")
    made = BatchFolder.begin(tmp_path / "out", each_row(tmp_path / "m.csv"))
    for name in "ab":
        (made.path / "rows" / name).mkdir()
    (made.path / "rows/a/state.json").write_text(text)
    (made.path / "rows/b/state.json").write_text(
        '{"failed": {"stage": "../../../x", "why": "w", "when": 1}}'
    )
    write_summary(made)
    one, other = json.loads((made.path / "summary.json").read_text())
    assert one["state"] == "failed" and "state.json: damaged" in one["why"]
    assert other["why"] == "w" and other["log"] == ""


def test_five_hundred_wrong_manifests_are_refused_in_words_or_stay_in_their_folders(tmp_path):
    rng = random.Random(49)
    (tmp_path / "one.mp4").touch()
    row = {"name": "a", "video": "one.mp4", "spec": "static", "set": ["train.steps=5"],
           "prepare": ["width=64"], "object": ["a ball"], "export": ["ply", "usd"],
           "publish": "s3://bucket/x", "device": "cpu", "gpus": 0.5, "memory_gb": 1.0,
           "auto": True}  # fmt: skip
    refused = kept = 0
    for number in range(500):
        wrong = dict(row)
        for key in rng.sample(sorted(row), rng.randint(1, 2)):
            value = rng.choice(NASTY)
            wrong[key] = [value] if isinstance(row[key], list) and rng.random() < 0.7 else value
        form = ("yaml", "csv", "back", "bytes")[number % 4]
        try:
            rows = _as(form, wrong, rng, tmp_path)
        except HoigsError as error:
            assert len(str(error)) < 2000
            refused += 1
            continue
        for found in rows:
            folder = tmp_path / "out" / "rows" / found.name
            stages = stages_of(found, folder)
            for stage in stages:
                for path in (stage.result, stage.locks, folder / f"{stage.name}.log"):
                    assert folder in Path(os.path.normpath(path)).parents, (wrong, path)
                words = (*stage.command, *stage.again, *stage.resume)
                assert not any("\0" in word for word in words), wrong
                assert not stage.command[1].startswith("-"), wrong
            kept += 1
    assert refused > 100 and kept > 20  # both ways were taken


def _as(form, row, rng, folder):
    """The rows of a manifest that has this one, written as one form or another."""
    text = json.dumps({"rows": [row]})
    if form == "back":
        out = BatchFolder(folder / "out")
        out.path.mkdir(exist_ok=True)
        lines = f'{{"fan_out": false}}\n{json.dumps(row)}\n'
        (out.path / BATCH).write_text(lines)
        return list(out.rows())
    if form == "csv":
        file = folder / "m.csv"
        with file.open("w", newline="", encoding="utf-8", errors="replace") as out:
            table = csv.writer(out)
            table.writerow(row)
            table.writerow(
                [";".join(map(str, v)) if isinstance(v, list) else v for v in row.values()]
            )
        return list(each_row(file))
    file = folder / "m.yaml"
    data = bytearray(text.encode())
    for _ in range(rng.randint(1, 4) if form == "bytes" else 0):
        at = rng.randrange(len(data))
        data[at : at + rng.randint(0, 3)] = rng.choice(
            (b"", b"\0", b"\xff", b"{", b"]", b"\n", b": ", b"!!int ", b"&a ", b"*a", b"- " * 2000)
        )
    file.write_bytes(data)
    return list(each_row(file))
