"""A run whose clip is gone is drawn as before; who asks for its pixels is told where to name it."""

from __future__ import annotations

import json
import shutil
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import hoigs as h
from hoigs.core.clip_folder.write import write_clip
from hoigs.core.errors import ClipError
from hoigs.core.values.clip import Clip
from hoigs.core.values.world import World
from hoigs.evaluation.evaluate import score
from hoigs.runs.kept_clip import load_kept, save_kept
from hoigs.runs.loaded_run import LoadedRun
from hoigs.testing.material import tiny_clip
from hoigs.training.session import Session

SMALL = [
    "train.steps=2", "train.preview_every=0", "train.log_every=1", "model.scene.points=60",
    "model.human.points=60", "model.object.points=60",
]  # fmt: skip


@pytest.fixture
def clip() -> Clip:
    times = tuple((i / 8) ** 2 for i in range(9))
    tiny = tiny_clip()
    objects = {n: replace(t, times=times, rotation_known=False) for n, t in tiny.objects.items()}
    return replace(tiny, objects=objects, world=World(up=(0.1, -1.0, 0.0), floor=-2.0))


def same(a: Any, b: Any) -> bool:
    if isinstance(a, torch.Tensor):
        return torch.equal(a, b)
    if is_dataclass(a):
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    if isinstance(a, dict):
        return set(a) == set(b) and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(same, a, b))
    return bool(a == b)


def test_bodies_of_version_1_have_the_joints_that_they_were_fitted_with(clip, tmp_path):
    file = tmp_path / "clip.npz"
    built_in = {name: replace(track, model="body:anny") for name, track in clip.bodies.items()}
    save_kept(replace(clip, bodies=built_in), file)
    models = []
    for version in (2, 1):
        arrays = dict(np.load(file))
        header = json.loads(str(arrays["header"])) | {"version": version}
        np.savez(file, **arrays | {"header": np.array(json.dumps(header))})
        models.append([track.model for track in load_kept(file).bodies.values()])
    assert models == [["body:anny"], ["body:anny-rig"]]


def test_all_but_pixels_and_colours_of_points_comes_back(clip, tmp_path):
    save_kept(clip, tmp_path / "clip.npz")
    kept = load_kept(tmp_path / "clip.npz")
    for name in sorted({f.name for f in fields(Clip)} - {"store", "point_colors"}):
        assert same(getattr(clip, name), getattr(kept, name)), name
    assert kept.point_colors.shape == kept.points.shape
    for ask in (kept.store.image, kept.store.depth, lambda i: kept.store.mask("object", i)):
        with pytest.raises(ClipError, match=r"frame 3.*--clip"):
            ask(3)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04torn"])
def test_a_damaged_one_is_named(content, tmp_path):
    (tmp_path / "clip.npz").write_bytes(content)
    with pytest.raises(ClipError, match=r"clip\.npz: damaged"):
        load_kept(tmp_path / "clip.npz")


def test_a_run_is_exported_without_its_clip_as_with_it(tmp_path):
    h.read_clip("builtin:carry?frames=4&width=32&height=32&test_frames=1")
    write_clip(
        h.read_clip("builtin:carry?frames=4&width=32&height=32&test_frames=1"), tmp_path / "clip"
    )
    run = tmp_path / "run"
    Session.open(tmp_path / "clip", "hoigs", out=run, overrides=SMALL).train()
    formats = ("ply-sequence", "bvh", "tracks")
    for name in formats:
        h.export(run, format=name, out=tmp_path / f"{name}.zip", device="cpu")
    moved = tmp_path / "else" / "where"
    shutil.move(run, moved)
    shutil.rmtree(tmp_path / "clip")
    for name in formats:
        h.export(moved, format=name, out=tmp_path / f"{name}-2.zip", device="cpu")
        first, second = (tmp_path / f"{name}{end}.zip" for end in ("", "-2"))
        assert first.read_bytes() == second.read_bytes(), name
    h.render(moved, out=tmp_path / "film.gif", device="cpu")
    with pytest.raises(ClipError, match=r"the clip of this run is not there.*--clip"):
        LoadedRun.open(moved)
    loaded = LoadedRun.open(moved, pixels=False)
    with pytest.raises(ClipError, match="--clip"):
        score(loaded.model, loaded.clip, timing_frames=0)
    (moved / "clip.npz").unlink()  # a run of before
    with pytest.raises(ClipError, match=r"the clip of this run is not there.*--clip"):
        LoadedRun.open(moved, pixels=False)


def test_a_run_of_before_keeps_it_once_it_goes_on(tmp_path):
    written = Path(__file__).resolve().parents[1] / "fixtures" / "written_by_0_1"
    shutil.copytree(written, tmp_path / "written")
    run = tmp_path / "written" / "run"
    assert not (run / "clip.npz").exists()
    Session.open(out=run, resume=True, overrides=["train.steps=8"])
    assert load_kept(run / "clip.npz").name == LoadedRun.open(run).clip.name


def test_a_run_whose_clip_cannot_be_kept_is_not_left_behind(tmp_path, monkeypatch):
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("hoigs.training.session.save_kept", full)
    clip = "builtin:carry?frames=4&width=32&scene_points=200"
    with pytest.raises(OSError, match="No space"):
        Session.open(clip, "static", out=tmp_path / "run", overrides=["model.scene.points=200"])
    assert not (tmp_path / "run").exists()
