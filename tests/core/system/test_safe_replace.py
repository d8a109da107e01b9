"""What may be replaced: a complete folder of hoigs's own; where not, nothing is touched."""

from __future__ import annotations

from pathlib import Path

import pytest

from hoigs.core.errors import ClipError, HoigsError
from hoigs.core.system.safe_replace import Layout, one_of, put_in_place, require_replaceable

LAYOUT = Layout(
    "thing", "hoigs", ("a.txt", "parts"), one_of(r"a\.txt", r"parts/\d+"), one_of("parts")
)


@pytest.fixture
def thing(tmp_path: Path) -> Path:
    (tmp_path / "thing" / "parts").mkdir(parents=True)
    (tmp_path / "thing" / "a.txt").write_text("old")
    (tmp_path / "thing" / "parts" / "1").write_text("")
    return tmp_path / "thing"


def test_what_is_complete_absent_or_empty_may_be_replaced(thing: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for folder in (thing, tmp_path / "absent", tmp_path / "empty"):
        require_replaceable(folder, LAYOUT, inputs=[tmp_path])


def test_what_is_not_complete_may_not(thing: Path) -> None:
    (thing / "a.txt").unlink()
    with pytest.raises(HoigsError, match=r"not a complete thing \(a\.txt absent\); name another"):
        require_replaceable(thing, LAYOUT)


def test_foreign_files_are_named(thing: Path) -> None:
    (thing / "photos" / "deep").mkdir(parents=True)
    (thing / "parts" / "one").touch()
    (thing / "parts" / "2").mkdir()  # a folder where hoigs writes a file
    (thing / "parts" / "3").symlink_to(thing)
    for i in range(4):
        (thing / f"z{i}").touch()
    with pytest.raises(ClipError) as error:
        require_replaceable(thing, LAYOUT, error=ClipError)
    assert "parts/2/, parts/one, photos/, z0, z1 and 2 more in it" in str(error.value)
    assert "move them away, or name another folder" in str(error.value)


def test_a_file_of_a_good_name_elsewhere_is_foreign(thing: Path) -> None:
    (thing / "parts" / "a.txt").touch()
    assert list(LAYOUT.foreign(thing)) == ["parts/a.txt"]


def test_places_that_are_never_replaced(
    thing: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "link").symlink_to(thing)
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    (tmp_path / "file").touch()
    for name in ("link", "dangling"):
        with pytest.raises(HoigsError, match="is a symbolic link"):
            require_replaceable(tmp_path / name, LAYOUT)
    with pytest.raises(HoigsError, match="is a file"):
        require_replaceable(tmp_path / "file", LAYOUT)
    for path in (thing, thing / "parts" / "1"):
        with pytest.raises(HoigsError, match="is or holds the input"):
            require_replaceable(thing, LAYOUT, inputs=[path])
    monkeypatch.chdir(thing / "parts")
    for folder in (Path(), Path(".."), thing):
        with pytest.raises(HoigsError, match="is the working directory or holds it"):
            require_replaceable(folder, LAYOUT)


def test_the_old_one_goes_last(thing: Path, tmp_path: Path) -> None:
    (tmp_path / "new").mkdir()
    put_in_place(tmp_path / "new", thing)
    assert [p.name for p in tmp_path.iterdir()] == ["thing"] and not any(thing.iterdir())


def test_the_old_one_comes_back_when_the_new_one_cannot_take_its_place(
    thing: Path, tmp_path: Path
) -> None:
    with pytest.raises(OSError):
        put_in_place(tmp_path / "absent", thing)
    assert (thing / "a.txt").read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["thing"]
