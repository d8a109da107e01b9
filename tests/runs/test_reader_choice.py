"""A folder is read by exactly one reader; two that know it are both named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from hoigs.core.errors import ClipError, PluginError
from hoigs.core.registry.manager import PluginManager
from hoigs.core.registry.registry import Registry, default_registry
from hoigs.runs.clip_source import ReaderChoice, choose_reader, recorded_reader


@pytest.fixture
def registry() -> Registry:
    manager = PluginManager()
    manager.load_file(Path(__file__).with_name("toy_readers.py"))
    return Registry(manager)


def made(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).touch()
    return folder


def chosen(choice: ReaderChoice) -> Any:
    return choice.reader


def test_the_one_that_knows_the_folder(registry: Registry, tmp_path: Path) -> None:
    assert choose_reader(made(tmp_path, "second.txt"), registry).key == "reader:second"


def test_a_general_layout_yields(registry: Registry, tmp_path: Path) -> None:
    """A NeuMan folder holds a COLMAP model, for example."""
    assert choose_reader(made(tmp_path, "wide.txt"), registry).key == "reader:wide"
    assert choose_reader(made(tmp_path, "first.txt"), registry).key == "reader:first"


def test_two_that_know_it_are_both_named(registry: Registry, tmp_path: Path) -> None:
    folder = made(tmp_path, "first.txt", "second.txt", "wide.txt")
    with pytest.raises(ClipError) as caught:
        choose_reader(folder, registry)
    assert "reader:first and reader:second recognise this layout" in str(caught.value)
    assert "--reader first or --reader second" in str(caught.value)
    assert choose_reader(folder, registry, "second").key == "reader:second"
    assert choose_reader(folder, registry, "reader:first").key == "reader:first"


def test_none_and_no_such_reader(registry: Registry, tmp_path: Path) -> None:
    with pytest.raises(ClipError, match="no reader of reader:first, reader:second"):
        choose_reader(tmp_path, registry)
    with pytest.raises(PluginError, match='did you mean "reader:first"'):
        choose_reader(tmp_path, registry, "frst")


def test_settings_are_checked(registry: Registry, tmp_path: Path) -> None:
    folder = made(tmp_path, "first.txt")
    reader = chosen(choose_reader(folder, registry, None, ["rate=1e-3", "ids=[1, 2]"]))
    assert (reader.rate, reader.ids, reader.model) == (0.001, [1, 2], None)
    with pytest.raises(ClipError, match=r'reader:first: rte: .*did you mean "rate"'):
        choose_reader(folder, registry, None, ["rte=2"])
    with pytest.raises(ClipError, match="reader:first: rate: "):
        choose_reader(folder, registry, None, ["rate=fast"])
    with pytest.raises(ClipError, match="--reader-set rate: expected key=value"):
        choose_reader(folder, registry, None, ["rate"])


def test_a_run_finds_its_reader_again_and_its_files(registry: Registry, tmp_path: Path) -> None:
    """Paths are kept as seen from the run, so that run and data can move together."""
    data, run = tmp_path / "data", tmp_path / "runs" / "a"
    data.mkdir()
    run.mkdir(parents=True)
    made(data, "first.txt", "second.txt", "body.npz")
    choice = choose_reader(data, registry, "second", [f"model={data / 'body.npz'}", "rate=3"])

    def relative(path: Path) -> str:
        return str(Path("..") / ".." / path.relative_to(tmp_path))

    record = choice.record(relative)
    assert record == {
        "use": "reader:second",
        "settings": {"model": "../../data/body.npz", "rate": 3.0},
    }
    moved = tmp_path / "moved"
    moved.mkdir()
    (tmp_path / "runs").rename(moved / "runs")
    data.rename(moved / "data")
    again = chosen(recorded_reader(record, moved / "runs" / "a", moved / "data", registry))
    assert again.rate == 3 and again.model.resolve() == (moved / "data/body.npz").resolve()


def test_built_in_readers_do_not_know_each_others_signs(tmp_path: Path) -> None:
    registry = default_registry()
    signs = {
        "reader:clip": ["clip.json"],
        "reader:hosnerf": ["cameras.pkl", "mesh_infos.pkl"],
        "reader:behave": ["info.json"],
        "reader:dnerf": ["transforms_train.json"],
        "reader:nerfstudio": ["transforms.json"],
        "reader:hold": ["build/data.npy"],
        "reader:colmap": ["sparse/0/cameras.bin", "images/1.png"],
        "reader:neuman": ["sparse/cameras.txt", "images/1.png", "alignments.npy"],
        "reader:exavatar": ["sparse/cameras.txt", "images/1.png", "frame_list_train.txt"],
        "reader:hypernerf": ["dataset.json", "camera/1.json"],
        "reader:arctic": ["images/s01/box_use_01/1/00001.jpg"],
    }
    assert set(signs) == set(registry.keys("reader"))
    for key, names in signs.items():
        folder = tmp_path / key.partition(":")[2]
        for name in names:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).touch()
        inner = {"reader:arctic": "images/s01/box_use_01"}
        assert choose_reader(folder / inner.get(key, ""), registry).key == key
