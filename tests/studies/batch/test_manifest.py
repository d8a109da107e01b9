"""Manifests: defaults and overrides, and messages with file, line and key."""

from __future__ import annotations

import pytest

from hoigs.studies.batch.manifest import ManifestError, read_manifest


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
