"""One message names every absent file of a layout and who makes it."""

from __future__ import annotations

from pathlib import Path

import pytest

from hoigs.core.errors import ClipError
from hoigs.plugins.readers.checked_files import Need, require_files

NEEDS = [
    Need.of("cameras.pkl", maker="cameras come from the authors"),
    *(Need.of(f"masks/{i:05d}.png", maker="masks come from a segmenter") for i in range(12)),
    Need.of("a/1/x.jpg", "a/1/x.png", maker="either"),
]


def test_a_whole_folder_passes(tmp_path: Path) -> None:
    for name in ("cameras.pkl", "a/1/x.png", *(f"masks/{i:05d}.png" for i in range(12))):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    require_files(tmp_path, "Toy", NEEDS)
    with pytest.raises(ClipError, match="masks are too small"):
        require_files(tmp_path, "Toy", NEEDS, ["masks are too small"])


def test_one_message_names_all(tmp_path: Path) -> None:
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks/00003.png").touch()
    with pytest.raises(ClipError) as caught:
        require_files(tmp_path, "Toy", NEEDS, ["and a fault"])
    assert str(caught.value).splitlines() == [
        f"{tmp_path} cannot be read as Toy:",
        "  cameras.pkl is absent: cameras come from the authors",
        "  masks/{00000-00002,00004-00011}.png (11 files) are absent: masks come from a segmenter",
        "  a/1/x.jpg or a/1/x.png is absent: either",
        "  and a fault",
    ]


def test_names_that_differ_in_two_numbers_are_all_told(tmp_path: Path) -> None:
    needs = [Need.of(f"t{i}/k{j}.jpg", maker="a camera") for i, j in ((0, 1), (4, 2))]
    with pytest.raises(ClipError, match=r"t0/k1\.jpg, t4/k2\.jpg \(2 files\) are absent: a camera"):
        require_files(tmp_path, "Toy", needs)


def test_no_folder(tmp_path: Path) -> None:
    with pytest.raises(ClipError, match="is not a folder; expected one in the layout of Toy"):
        require_files(tmp_path / "x", "Toy", NEEDS)


def test_a_folder_is_not_a_file(tmp_path: Path) -> None:
    (tmp_path / "thing").mkdir()
    assert Need.of("thing", maker="m").found(tmp_path) is None
    assert Need.of("thing/", maker="m").found(tmp_path) == tmp_path / "thing"
