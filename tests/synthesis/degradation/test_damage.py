"""Faults of files and frames are put where a setting puts them, and only there."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from hoigs.core.clip_folder.check import check_clip
from hoigs.core.clip_folder.health import examine
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.plugins.readers.clip import ClipFolderReader
from hoigs.synthesis import NoiseConfig, SceneConfig, SyntheticScene
from hoigs.synthesis.builtin import write_scene
from hoigs.synthesis.degradation import damage, frames_kept, with_frames_dropped


@pytest.fixture
def folder(tmp_path: Path, scene: SyntheticScene) -> Path:
    write_scene(scene, tmp_path / "clip")
    return tmp_path / "clip"


def test_nothing_is_damaged_by_default(folder: Path) -> None:
    before = {p: p.stat().st_mtime_ns for p in folder.rglob("*")}
    damage(folder, NoiseConfig(), seed=0)
    assert {p: p.stat().st_mtime_ns for p in folder.rglob("*")} == before


def test_files_go_missing_and_depth_becomes_nan_at_their_shares(folder: Path) -> None:
    noise = NoiseConfig(mask_absent=0.25, frames_absent=0.125, depth_nan=0.2)
    damage(folder, noise, seed=0)
    assert len(list(folder.glob("masks/*/*.png"))) == 36  # of two times 24
    assert len(list(folder.glob("images/*.png"))) == 21
    with np.load(folder / "depth/00003.npz") as archive:
        assert np.isnan(archive["depth"]).mean() == pytest.approx(0.2, abs=0.03)
    problems = check_clip(folder)
    assert problems and all(p.severity == "fair" for p in problems)
    assert not any(p.path.startswith("held_out") for p in problems)
    reader = ClipFolderReader()
    reader.allow_faults = True
    kinds = {fault.kind for fault in examine(reader.read(folder))}
    assert {"missing-masks", "missing-frames", "nan-depth"} <= kinds


def test_dropped_frames_leave_no_trace_but_a_jump(scene: SyntheticScene, tmp_path: Path) -> None:
    kept = frames_kept(24, 0.125, seed=0)
    lost = sorted(set(range(24)) - set(kept))
    assert len(lost) == 3 and 0 in kept and 23 in kept
    assert all(b - a > 1 for a, b in pairwise(lost)), "no two in a row"
    noise = scene.config.noise.model_copy(update={"frames_dropped": 0.125})
    config = scene.config.model_copy(update={"noise": noise})
    short = with_frames_dropped(replace(scene, config=config))
    assert short.config.frames == len(short.cameras) == len(short.poses.transl) == 21
    assert short.script.track.translations.shape == (21, 3)
    np.testing.assert_array_equal(short.poses.transl.numpy(), scene.poses.transl.numpy()[kept])
    for frame, camera in short.held_out:
        assert (kept[frame], camera) in scene.held_out
    write_scene(replace(scene, config=config), tmp_path / "short")
    clip = ClipFolderReader().read(tmp_path / "short")
    assert len(clip) == 21 and clip.faults == []
    gaps = [fault for fault in examine(clip) if fault.kind == "missing-frames"]
    assert len(gaps) == 1 and set(gaps[0].frames) <= {kept.index(i - 1) for i in lost}
    with np.load(tmp_path / "short/truth.npz") as truth:
        assert len(truth["object_rotations"]) == len(truth["K"]) == 21


def test_settings_do_not_change_each_others_draws(body: AnnyBody) -> None:
    """Poses of a clip are the same noise whether or not its masks are damaged too."""
    from hoigs.synthesis import generate

    tiny = SceneConfig.tiny(frames=4, held_out_views=0, noise={"mask_absent": 0.5})
    assert generate(tiny, body).config.noise.mask_absent == 0.5
    assert frames_kept(10, 0.0, seed=3) == list(range(10))
