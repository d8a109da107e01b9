"""my.prompts.json: written, read as options, and behind those that are given."""

from __future__ import annotations

from pathlib import Path

import pytest

from hoigs.core.errors import SpecError
from hoigs.preparation.options import PrepareOptions
from hoigs.preparation.prepare import work_folder
from hoigs.preparation.prompts import (
    StoredPrompts,
    prompt_file,
    with_prompts,
    with_stored,
    write_prompts,
)
from hoigs.studies.needs.auto import needs_of
from hoigs.studies.needs.compress import compact_of

TEXTS = ("30,20@0", "-10,5@0", "1,2,30,40@4")


def test_stored_clicks_are_what_options_say(tmp_path: Path) -> None:
    video = tmp_path / "my.mp4"
    assert with_stored(PrepareOptions(), video) == (PrepareOptions(), ())
    write_prompts(video, StoredPrompts(TEXTS, ("7,8@3",)))
    assert [p.name for p in tmp_path.iterdir()] == ["my.prompts.json"]
    options, said = with_stored(PrepareOptions(), video)
    assert options.prompts["object"] == with_prompts(PrepareOptions(object=TEXTS)).prompts["object"]
    assert options.prompts["human"].points == [(7, 8, True)]
    assert "my.prompts.json, beside the video: object in frame 0, 4" in said
    write_prompts(video, StoredPrompts(("ball=3,4@1",)))
    named, _ = with_stored(PrepareOptions(), video)
    assert named.object_name == "ball" and named.prompts["ball"].frame == 1
    write_prompts(video, StoredPrompts(("cup=1,2@0", "pot=3,4@0")))
    both, said = with_stored(PrepareOptions(), video)
    assert both.objects == ("cup", "pot") and len(said) == 2
    write_prompts(video, StoredPrompts())
    assert not prompt_file(video).exists()


def test_options_come_first(tmp_path: Path) -> None:
    video = tmp_path / "my.mp4"
    write_prompts(video, StoredPrompts(TEXTS))
    for given in ("9,9@2", "none"):
        options = with_prompts(PrepareOptions(object=given))
        kept, said = with_stored(options, video)
        assert kept == options and "your options come first" in said[0]


def test_what_cannot_be_used_is_named(tmp_path: Path) -> None:
    video = tmp_path / "my.mp4"
    write_prompts(video, StoredPrompts((), ("ann=1,2@0", "ben=3,4@0")))
    options, said = with_stored(PrepareOptions(), video)
    assert options.people == ("ann", "ben") and len(said) == 2
    for text, message in (("[]", "None"), ('{"version": 1, "object": [3]}', "object.*3")):
        prompt_file(video).write_text(text)
        with pytest.raises(SpecError, match=message):
            with_stored(PrepareOptions(), video)


@pytest.mark.parametrize("where", [".", "..", "frames/..", "../my"])
def test_a_folder_may_be_named_by_a_dot(tmp_path, monkeypatch, where) -> None:
    inside = tmp_path / "my" / "frames" if where == ".." else tmp_path / "my"
    (tmp_path / "my" / "frames").mkdir(parents=True)
    monkeypatch.chdir(inside)
    write_prompts(Path(where), StoredPrompts(TEXTS))
    assert (tmp_path / "my.prompts.json").is_file()
    names = {
        work_folder(Path(where)).name,
        compact_of(Path(where)).name,
        needs_of(Path(where)).name,
    }
    assert names == {"my.prepare", "my-compact", "my-needs"}
