"""Films: every path draws the run from where it says; files hold what was asked for."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import av
import numpy as np
import pytest
import torch
from exported_run import tiny_run
from PIL import Image

import hoigs as h
from hoigs.core.errors import HoigsError
from hoigs.core.values.between import frame_numbers, frame_of
from hoigs.runs.loaded_run import LoadedRun
from hoigs.viewing.films import dithered, fitted, source_frame
from hoigs.viewing.paths import best_moment, film_path, rate_of


@pytest.fixture(scope="module")
def run() -> LoadedRun:
    return LoadedRun.open(tiny_run())


def views(run, path, **settings):
    numbers, fps = frame_numbers(run.clip)
    return film_path(run.model, run.clip, path, numbers, fps, **settings)


def test_the_video_is_the_clip(run):
    for i, (moment, camera) in enumerate(views(run, "video")):
        assert moment.poses is run.clip.moments[i].poses and camera is run.clip.cameras[i]


@pytest.fixture
def two_shapes(run) -> LoadedRun:
    """The run on upright and square pictures of the same cameras."""
    cameras = [c.cropped(8, 0, 48, 64) if i < 5 else c for i, c in enumerate(run.clip.cameras)]
    return replace(run, clip=replace(run.clip, cameras=cameras))


@pytest.mark.parametrize("path", ["video", "bullet-time", "spiral", "follow object"])
def test_pictures_of_several_shapes_make_films_of_one(two_shapes, run, path):
    numbers, fps = frame_numbers(run.clip, slow=2.0)  # also between one shape and the other
    film = film_path(two_shapes.model, two_shapes.clip, path, numbers, fps)
    assert {(camera.width, camera.height) for _, camera in film} == {(64, 64)}
    if path == "video":  # an upright picture has more of the world beside it
        for i, (_, camera) in enumerate(film_path(run.model, run.clip, path, numbers, fps)):
            assert torch.allclose(film[i][1].K, camera.K, atol=1e-4)


def test_a_film_of_several_shapes_beside_the_video(two_shapes, tmp_path, monkeypatch):
    monkeypatch.setattr(LoadedRun, "open", lambda *_, **__: two_shapes)
    done = h.render("run", out=tmp_path / "c.mp4", compare=True, width=96, height=48, end=6.0)
    assert (done.frames, done.width, done.height) == (7, 96, 48)
    camera = replace(two_shapes.clip.cameras[0], width=128, height=64)
    beside = source_frame(two_shapes.clip, 0.0, camera, 3, shape=(128, 64))
    assert not beside[:, :32].any() and not beside[:, 96:].any()
    assert (beside[:, 32:96] == two_shapes.clip.store.image(0).numpy()).all()


def test_bullet_time_stands_still_while_the_camera_moves(run):
    film = views(run, "bullet-time", at=4.5)
    shown = [frame_of(run.clip, moment) for moment, _ in film]
    still = [i for i, frame in enumerate(shown) if frame == 4.5]
    assert shown == sorted(shown) and len(still) == 12 == len(film) - len(run.clip)
    places = torch.stack([film[i][1].center for i in still])
    assert torch.linalg.vector_norm(places[3] - places[9]) > 1.0  # to both sides
    assert 1 <= best_moment(run.model, run.clip, frame_numbers(run.clip)[0]) <= 10


def test_a_followed_entity_keeps_its_pixel(run):
    film = views(run, "follow object")
    seen = []
    for moment, camera in film:
        with torch.no_grad():
            means = run.model(moment, ["object"]).gaussians["object"].means
        seen.append(camera.project(means.mean(0)[None])[0][0])
    own = torch.stack(seen)
    assert (own - own.mean(0)).norm(dim=-1).max() < 6  # of 64 pixels; the path is smoothed
    with pytest.raises(HoigsError, match="expected one of human, object"):
        views(run, "follow scene")


def test_spiral_looks_at_the_person(run):
    pelvis = run.model.entity("human").deformation.anchors(run.clip.moments[6])[0]
    pixels = torch.stack([c.project(pelvis[None])[0][0] for _, c in views(run, "spiral")])
    assert (pixels - pixels[0]).abs().max() < 0.01


def test_keyed_cameras_of_ours_and_of_nerfstudio(run, tmp_path):
    keys = [
        {"at": 0, "position": [0, 1, -3], "look_at": [0, 1, 0], "frame": 2},
        {"at": 1, "position": [1, 1, -3], "look_at": [0, 1, 0], "fov": 30, "frame": 4},
    ]
    (tmp_path / "own.json").write_text(json.dumps({"keys": keys}))
    film = views(run, str(tmp_path / "own.json"))
    assert frame_of(run.clip, film[0][0]) == 2 and frame_of(run.clip, film[-1][0]) == 4
    assert torch.allclose(film[0][1].center, torch.tensor([0.0, 1.0, -3.0]), atol=1e-5)
    last = film[-1][1]
    assert math.degrees(2 * math.atan(last.height / 2 / float(last.K[1, 1]))) == pytest.approx(30)

    camera = run.clip.cameras[3]
    pose = torch.linalg.inv(camera.world_to_camera) @ torch.diag(torch.tensor([1.0, -1, -1, 1]))
    fov = math.degrees(2 * math.atan(camera.height / 2 / float(camera.K[1, 1])))
    entry = {"camera_to_world": pose.flatten().tolist(), "fov": fov, "aspect": 1}
    path = {"camera_type": "perspective", "render_width": 64, "render_height": 64}
    (tmp_path / "ns.json").write_text(json.dumps(path | {"camera_path": [entry, entry]}))
    film = views(run, str(tmp_path / "ns.json"))
    assert len(film) == 2
    assert torch.allclose(film[0][1].world_to_camera, camera.world_to_camera, atol=1e-4)
    (tmp_path / "ns.json").write_text(json.dumps(path | {"camera_path": [entry] * 3, "seconds": 6}))
    assert rate_of(tmp_path / "ns.json") == 0.5 and rate_of(tmp_path / "own.json") is None
    bad = ("{", "{}", '{"keys": []}', '{"camera_path": [{}]}', '{"camera_path": [], "crop": {}}')
    for text in (*bad, '{"camera_path": [], "camera_type": "equirectangular"}'):
        (tmp_path / "bad.json").write_text(text)
        with pytest.raises(HoigsError, match=r"bad\.json"):
            views(run, str(tmp_path / "bad.json"))


def test_no_such_path(run):
    with pytest.raises(HoigsError, match='did you mean "orbit"'):
        views(run, "orbti")


def test_dithering_has_the_mean_of_the_colour():
    ramp = torch.linspace(0.2, 0.21, 64).expand(64, 64)[..., None].repeat(1, 1, 3)
    picture = dithered(ramp)
    assert np.abs(picture.mean((0, 2)) / 255 - ramp[0, :, 0].numpy()).max() < 0.2 / 255
    assert np.abs(picture / 255.0 - ramp.numpy()).max() <= 1 / 255
    assert len(np.unique(picture[:8, :8])) == 2  # steps are mixed, not a band
    full = torch.tensor([[[0.0, 1.0, 2.0]]])
    assert dithered(full).tolist() == [[[0, 255, 255]]]


def test_sizes(run):
    camera = run.clip.cameras[0]
    wide = fitted(camera, 96, 48)
    assert (wide.width, wide.height) == (96, 48) and wide.K[0, 0] == 1.5 * camera.K[0, 0]
    assert fitted(camera, None, 32).width == 32
    with pytest.raises(HoigsError, match="even number"):
        fitted(camera, 97, None)


def test_compared_and_transparent_files(run, tmp_path):
    done = h.render(tiny_run(), out=tmp_path / "c.mp4", compare=True, end=1.0, device="cpu")
    with av.open(str(tmp_path / "c.mp4")) as container:
        frames = [f.to_ndarray(format="rgb24") for f in container.decode(video=0)]
    assert len(frames) == 2 == done.frames and frames[0].shape == (64, 128, 3)
    source = run.clip.store.image(1).numpy().astype(int)
    assert np.abs(frames[1][:, :64].astype(int) - source).mean() < 10  # 4:2:0 chroma of few pixels
    h.render(
        tiny_run(), out=tmp_path / "t.mov", background="transparent", entities=["human"], end=0.0,
        device="cpu",
    )  # fmt: skip
    with av.open(str(tmp_path / "t.mov")) as container:
        alpha = next(container.decode(video=0)).to_ndarray(format="rgba")[..., 3]
    assert alpha.min() == 0 and alpha.max() > 200
    h.render(tiny_run(), out=tmp_path / "b.gif", background="white", end=1.0, device="cpu")
    assert Image.open(tmp_path / "b.gif").n_frames == 2


def test_bad_input_is_answered_and_leaves_nothing(hoigs, tmp_path):
    out = tmp_path / "x.mp4"
    for arguments, words in (
        (["--path", "bulet-time"], ['"bullet-time"']),
        (["--background", "transparent"], [".webm", ".mov", ".gif"]),
        (["--background", "whiet"], ["whiet"]),
        (["--entities", "humn"], ["--entities humn", '"human"']),
        (["--width", "63"], ["width 63"]),
        (["--from", "40"], ["--from 40", "0 to 11"]),
        (["--fps", "nan"], ["--fps", "nan"]),
        (["--entities", "foo"], ["--entities foo", "scene, human, object"]),
    ):
        done = hoigs("render", tiny_run(), "--out", out, *arguments)
        assert done.code == 2 and all(word in done.err for word in words), (arguments, done.err)
    done = hoigs("render", tiny_run(), "--out", tmp_path / "x.avi")
    assert done.code == 2 and ".mp4" in done.err
    assert not list(tmp_path.iterdir())
