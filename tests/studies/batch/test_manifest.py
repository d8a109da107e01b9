"""Manifests: defaults and overrides, and messages with file, line and key."""

from __future__ import annotations

import json

import pytest

from hoigs.studies.batch import manifest
from hoigs.studies.batch.folder import BATCH, BatchFolder
from hoigs.studies.batch.manifest import ManifestError, each_row, read_manifest
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
    rows = read_manifest(tmp_path / "m.yaml", {"spec": "hoigs", "device": "cpu"})
    assert [(r.name, r.spec, r.set, r.device) for r in rows] == [
        ("one", "static", ("train.steps=5",), "cpu"),
        ("zwei", "static", ("train.steps=7",), "cpu"),
    ]
    assert read_manifest(tmp_path / "m.csv", {"device": "cpu"}) == rows


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rows:\n  - video: oen.mp4\n", r'm\.yaml:2:\S* video: .*did you mean "one.mp4"'),
        ("rows:\n  - vidoe: one.mp4\n", r'm\.yaml:2:\S* vidoe: .*did you mean "video"'),
        ("row:\n  - video: one.mp4\n", r'm\.yaml:1:\S* row: .*did you mean "rows"'),
        ("rows:\n  - {video: one.mp4, clip: one.mp4}\n", "either a video or a clip"),
        ("rows:\n  - video: one.mp4\n    auto: maybe\n", r"m\.yaml:3:\S* auto: .*'maybe'"),
        ("rows:\n  - video: one.mp4\n    name: ../x\n", r"m\.yaml:3:\S* name: "),
        ("rows:\n  - video: one.mp4\n  - video: one.mp4\n", r'name: "one" is also the row at'),
        ("rows: []\n", "has no rows"),
    ],
)
def test_mistakes_are_found_where_they_are(tmp_path, text, message):
    (tmp_path / "one.mp4").touch()
    (tmp_path / "m.yaml").write_text(text)
    with pytest.raises(ManifestError, match=message):
        read_manifest(tmp_path / "m.yaml")


def test_rows_are_checked_before_a_folder_is_made(tmp_path):
    (tmp_path / "m.csv").write_text("clip,name\nbuiltin:carry,a\nbuiltin:carry,A\n")
    with pytest.raises(ManifestError, match=r'm.csv:3: name: "A" is also the row at .*m.csv:2'):
        BatchFolder.begin(tmp_path / "out", each_row(tmp_path / "m.csv"))
    assert not list(tmp_path.glob("out/*"))
    (tmp_path / "m.csv").write_text("clip,name\ngone,a\n")
    with pytest.raises(ManifestError, match="does not exist"):
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
