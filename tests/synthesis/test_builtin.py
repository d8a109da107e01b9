from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from hoigs.core.clip_folder.check import check_clip
from hoigs.core.values.clip import Clip
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.plugins.readers.clip import ClipFolderReader
from hoigs.synthesis import SceneConfig, builtin, builtin_clip, cache_folder


@pytest.fixture(scope="module")
def clip(clip_folder: Path) -> Clip:
    return ClipFolderReader().read(clip_folder)


@pytest.fixture
def cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setenv("HOIGS_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


SMALLEST = {"frames": 4, "width": 16, "height": 16, "held_out_views": 1}


def test_the_folder_is_a_whole_clip(clip_folder: Path, clip: Clip) -> None:
    assert check_clip(clip_folder) == []
    config = SceneConfig.tiny()
    assert len(clip) == config.frames and clip.num_frames == config.frames
    assert clip.depth_kind == "metric" and clip.fps == config.fps
    assert clip.kinds["human"] == "human" and clip.kinds["object"] == "object"
    assert len(clip.split["test"]) == 3
    assert clip.bodies["human"].model == "body:anny"
    assert clip.objects["object"].provenance == "synthetic truth"
    assert clip.provenance["config"]["object"]["motion"] == "held"
    assert clip.provenance["poses_exact"] is True


def test_frames_read_back(clip: Clip) -> None:
    frame = clip[5]
    assert frame.image.shape == (64, 64, 3) and frame.image.float().std() > 20
    human, thing = frame.masks["human"], frame.masks["object"]
    assert human.any() and thing.any() and not (human & thing).any()
    assert frame.depth is not None
    assert (frame.depth > 0).all() and frame.depth[human].mean() < frame.depth.mean()


def test_held_out_views_show_the_same_moments(clip: Clip) -> None:
    assert clip.held_out is not None and len(clip.held_out) == 3
    for view in clip.held_out:
        same = clip.moments[view.moment.index]
        assert torch.equal(view.moment.poses["human"].body, same.poses["human"].body)
        assert view.masks["human"].any() and view.image.float().std() > 20


def test_scene_points_lie_on_what_the_cameras_see(clip: Clip) -> None:
    assert clip.points.shape == (2000, 3)
    pixels, depth = clip.cameras[0].project(clip.points)
    inside = ((pixels >= 0) & (pixels < 64)).all(-1)
    assert inside.float().mean() > 0.6
    frame = clip[0]
    columns, rows = pixels[inside].long().T
    gap = depth[inside] - frame.depth[rows, columns]
    assert (gap.abs() < 0.08).float().mean() > 0.7
    colors = frame.rgb[rows, columns]
    near = gap.abs() < 0.08
    assert (colors - clip.point_colors[inside])[near].abs().mean() < 0.12


def test_object_points_ride_on_the_track(clip: Clip) -> None:
    track = clip.objects["object"]
    half = torch.tensor(SceneConfig().object.size) / 2
    assert len(track.points) == 300 and track.observed.all()
    assert ((track.points.abs() - half).max(-1).values.abs() < 0.02).all()
    for position in (0, 6, 11):
        frame = clip[position]
        world = track.points @ track.rotations[position].mT + track.translations[position]
        pixels, depth = frame.camera.project(world)
        columns, rows = pixels.long().clamp(0, 63).T
        front = (depth - frame.depth[rows, columns]).abs() < 0.03
        assert frame.masks["object"][rows, columns][front].float().mean() > 0.85
        assert front.float().mean() > 0.2


def test_truth_agrees_with_the_clip(clip_folder: Path, clip: Clip) -> None:
    with np.load(clip_folder / "truth.npz") as truth:
        np.testing.assert_allclose(truth["K"][3], clip.cameras[3].K)
        np.testing.assert_allclose(truth["body"], clip.bodies["human"].poses.body)
        track = clip.objects["object"]
        np.testing.assert_allclose(truth["object_rotations"], track.rotations, atol=1e-6)
        assert truth["object_vertices"].shape == (24, 3)
        assert truth["object_bend"].max() == 0 and truth["grip"].max() == 1
        assert truth["dressed_vertices"].shape[1] == 3


def test_the_second_call_takes_the_cached_folder(
    body: AnnyBody, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[tuple[int, int]] = []
    config = SceneConfig.tiny(**SMALLEST)
    first = builtin_clip(body, config, progress=lambda done, of: calls.append((done, of)))
    assert calls == [(0, 4), (1, 4), (2, 4), (3, 4), (4, 4)]
    assert first.is_relative_to(cache)
    assert json.loads((first / "clip.json").read_text())["name"] == "lift-and-swing"

    def never(*_: object) -> None:
        raise AssertionError("generated again")

    monkeypatch.setattr(builtin, "generate", never)
    assert builtin_clip(body, config) == first
    with pytest.raises(AssertionError, match="generated again"):
        builtin_clip(body, SceneConfig.tiny(**SMALLEST, seed=1))


def test_a_failure_leaves_nothing(
    body: AnnyBody, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("the disk is full")

    monkeypatch.setattr(builtin, "save_truth", fail)
    with pytest.raises(RuntimeError, match="the disk is full"):
        builtin_clip(body, SceneConfig.tiny(**SMALLEST))
    assert list((cache / "clips").iterdir()) == []


def test_the_name_covers_config_body_and_generator(
    body: AnnyBody, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = SceneConfig.tiny()
    base = config.digest(builtin.generator_version(), builtin.body_digest(body, config))
    assert config.digest("another", builtin.body_digest(body, config)) != base
    other = SceneConfig.tiny(light={"sun": 0.9})
    assert other.digest(builtin.generator_version(), builtin.body_digest(body, other)) != base
    tall = SceneConfig.tiny(betas=(1.0,))
    assert builtin.body_digest(body, tall) != builtin.body_digest(body, config)


def test_the_cache_is_where_the_environment_says(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOIGS_CACHE", "~/elsewhere")
    assert cache_folder() == Path.home() / "elsewhere"
    monkeypatch.delenv("HOIGS_CACHE")
    assert cache_folder() == Path.home() / ".cache" / "hoigs"


def test_noise_reaches_the_clip_but_not_its_truth(body: AnnyBody, cache: Path) -> None:
    noise = {"pose_degrees": 5.0, "camera_degrees": 1.0, "object_metres": 0.02,
             "depth_scale": 1.25, "mask_missing": 0.5}  # fmt: skip
    small = {**SMALLEST, "frames": 6}
    clean = ClipFolderReader().read(builtin_clip(body, SceneConfig.tiny(**small)))
    folder = builtin_clip(body, SceneConfig.tiny(**small, noise=noise))
    noisy = ClipFolderReader().read(folder)
    assert torch.equal(clean[0].image, noisy[0].image)
    torch.testing.assert_close(noisy[0].depth, 1.25 * clean[0].depth)
    assert not torch.equal(noisy.cameras[0].world_to_camera, clean.cameras[0].world_to_camera)
    gone = [not frame.masks["human"].any() for frame in noisy]
    assert any(gone) and not all(gone)
    assert clean.held_out is not None and noisy.held_out is not None
    assert torch.equal(clean.held_out[0].depth, noisy.held_out[0].depth)
    with np.load(folder / "truth.npz") as truth:
        np.testing.assert_allclose(truth["body"], clean.bodies["human"].poses.body)
        np.testing.assert_allclose(truth["world_to_camera"][0], clean.cameras[0].world_to_camera)
        shift = noisy.objects["object"].translations.numpy() - truth["object_translations"]
    assert 0.002 < np.abs(shift).mean() < 0.06
