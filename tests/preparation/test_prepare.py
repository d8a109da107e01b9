"""A source folder becomes a clip folder: a tiny made-up one, and the first frames of real ones."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from test_cameras import FOCAL, colmap_model
from tiny import BALL, FRAMES, HEIGHT, WIDTH, background, landmarks, make_source, masks

from hoigs.core.clip_folder.check import check_clip
from hoigs.core.errors import ClipError, HoigsError, SpecError
from hoigs.core.values.clip import Clip
from hoigs.core.values.lens import Lens
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.plugins.readers.clip import ClipFolderReader
from hoigs.preparation import stages
from hoigs.preparation.objects.make_object import MadeObject, make_object
from hoigs.preparation.prepare import PrepareOptions, PrepareReport, prepare
from hoigs.preparation.video.frames import VideoFrames
from hoigs.preparation.video.pictures import Picture
from hoigs.preparation.video.source import SourceError

QUICK = {"fit_steps": 5, "overlay_width": 0}  # what is tested here is not the fit


@pytest.fixture(scope="module")
def body() -> AnnyBody:
    return AnnyBody()


@pytest.fixture(scope="module")
def static(
    tmp_path_factory: pytest.TempPathFactory, tiny_video: Path, body: AnnyBody
) -> tuple[Path, PrepareReport, list[float]]:
    """The tiny source, prepared once: the clip, the report and the reported progress."""
    folder = tmp_path_factory.mktemp("static")
    seen: list[float] = []
    report = prepare(
        make_source(folder / "source", tiny_video),
        folder / "clip",
        body=body,
        options=PrepareOptions(fit_steps=25),
        progress=lambda done, _: seen.append(done),
    )
    return folder / "clip", report, seen


def prepared(
    source: Path, out: Path, body: AnnyBody, **options: object
) -> tuple[Clip, PrepareReport]:
    report = prepare(source, out, body=body, options=PrepareOptions(**{**QUICK, **options}))  # type: ignore[arg-type]
    assert check_clip(out) == []
    return ClipFolderReader().read(out), report


def test_borders_of_a_distorted_video_are_kept_if_asked(
    tiny_source: Path, tmp_path: Path, body: AnnyBody
) -> None:
    """Of a lens with barrel distortion, the undistorted image is larger than the frame."""
    intrinsics = (60.0, 60.0, WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5, -0.15, 0.0, 0.0, 0.0)
    options = {"intrinsics": intrinsics, "camera": "static", "fit_steps": 3}
    cut, _ = prepared(tiny_source, tmp_path / "cut", body, **options)
    clip, report = prepared(tiny_source, tmp_path / "whole", body, keep_borders=True, **options)
    small, large = cut.cameras[0], clip.cameras[0]
    left, top = ((a - b) // 2 for a, b in ((large.width, WIDTH), (large.height, HEIGHT)))
    assert (small.width, small.height) == (WIDTH, HEIGHT) and left > 4 and top > 2
    assert (report.width, report.height) == (large.width, large.height)
    assert torch.equal(large.cropped(left, top, WIDTH, HEIGHT).K, small.K)
    inner = slice(top, top + HEIGHT), slice(left, left + WIDTH)
    for one, other in zip(clip, cut, strict=True):
        assert (one.image[inner].float() - other.image.float()).abs().mean() < 1.5
        assert (one.masks["human"][inner] == other.masks["human"]).float().mean() > 0.99
        assert one.ignored is not None and not one.ignored[inner].any() and one.ignored[0, 0]
        ball, same = (c.objects["object"].translations[one.position] for c in (clip, cut))
        moved = one.camera.project(ball)[0] - other.camera.project(same)[0]
        assert (moved - torch.tensor([left, top])).abs().max() < 0.5
    # the corners of the video's frame have a place, and the colours of the ramp there
    lens = Lens("OPENCV", (60.0, 60.0, WIDTH / 2, HEIGHT / 2, -0.15, 0.0, 0.0, 0.0), WIDTH, HEIGHT)
    corners = np.array([[2.5, 2.5], [WIDTH - 2.5, HEIGHT - 2.5]])
    places = lens.undistortion().pixels(corners) + np.array([left, top])
    for corner, place in zip(corners.astype(int), places.astype(int), strict=True):
        assert not clip[0].ignored[place[1], place[0]]
        shown = clip[0].image[place[1], place[0]].numpy().astype(float)
        assert np.abs(shown - background()[corner[1], corner[0]]).max() < 12


@pytest.mark.parametrize("keep_black", [False, True])
def test_pixels_that_the_lens_does_not_show_are_ignored(
    tiny_source: Path, tmp_path: Path, body: AnnyBody, keep_black: bool
) -> None:
    """Of a lens with pincushion distortion, the undistorted image has empty corners."""
    K = np.array([[FOCAL, 0, WIDTH / 2 - 0.5], [0, FOCAL, HEIGHT / 2 - 0.5], [0, 0, 1]])
    k = (0.3, 0.0, 0.0, 0.0)  # as OpenCV has them, whose first pixel is at 0
    intrinsics = (FOCAL, FOCAL, K[0, 2], K[1, 2], *k)
    options = {"intrinsics": intrinsics, "camera": "static", "keep_black": keep_black}
    clip, report = prepared(tiny_source, tmp_path / "clip", body, **options)
    outside = Lens.opencv(K, k, WIDTH, HEIGHT, pixel_center=0).undistortion().outside
    assert outside is not None and 0.02 < outside.mean() < 0.5
    for frame in clip:
        assert (frame.ignored.numpy() == outside).all()
        assert not any((mask.numpy() & outside).any() for mask in frame.masks.values())
    assert not any("black" in warning for warning in report.warnings)


def test_static_camera_and_ball(
    static: tuple[Path, PrepareReport, list[float]], body: AnnyBody
) -> None:
    out, report, seen = static
    clip = ClipFolderReader().read(out)
    assert seen == sorted(seen) and seen[0] == 0 and seen[-1] == pytest.approx(1)
    assert len(clip) == FRAMES and clip.kinds == {"human": "human", "object": "object"}
    assert clip.depth_kind == "none" and clip.fps == 12
    assert clip.world.known in ("body", "floor")  # cameras are level here, so they agree
    assert float(clip.up() @ torch.tensor((0.0, -1.0, 0.0))) > np.cos(np.radians(10))
    assert clip.world.floor is not None
    track = clip.objects["object"]
    assert track.observed.tolist() == [i != 5 for i in range(FRAMES)]
    for i, frame in enumerate(clip):
        xy, _ = frame.camera.project(track.translations[i])
        assert np.abs(xy.numpy() - BALL(i)[:2]).max() < 0.6
        assert not (frame.masks["human"] & frame.masks["object"]).any()
        if i != 5:
            true = torch.from_numpy(masks(i)[1])
            assert float((frame.masks["object"] & true).sum() / true.sum()) > 0.9
    assert len(clip.points) == report.scene_points > 5000, "nearly one a pixel: the clip is tiny"
    # the ball is bright, the background what was behind the person
    assert float(track.colors.median()) > 0.75
    xy, _ = clip.cameras[0].project(clip.points)
    column, row = xy.floor().long().numpy().T
    error = np.abs(clip.point_colors.numpy() - background()[row, column] / 255)
    assert np.median(error) < 0.03
    # the body stands where the landmarks are, upright, 2.8 m away give or take the shape
    pelvis = body(clip.moments[6].poses["human"]).joints[0]
    assert abs(float(clip.cameras[6].project(pelvis)[0][0]) - WIDTH / 2) < 3
    assert 2.0 < float(pelvis[2]) < 3.6
    assert report.camera == "static" and report.parallax_degrees == pytest.approx(0, abs=1e-3)
    assert report.body_residual_px < 3
    assert report.coverage["object"][5] == 0


def test_files_beside_the_clip(static: tuple[Path, PrepareReport, list[float]]) -> None:
    out, _, _ = static
    numbers = json.loads((out / "report.json").read_text())
    assert numbers["frames"] == FRAMES and numbers["seconds"]["write"] > 0
    assert "estimated from the person" in (out / "report.md").read_text()
    overlay = VideoFrames(out / "overlay.mp4")
    assert (len(overlay), overlay.width) == (FRAMES, WIDTH)
    assert sorted(p.name for p in out.parent.iterdir()) == ["clip", "clip.prepare", "source"]


def test_options(tiny_source: Path, tmp_path: Path, body: AnnyBody) -> None:
    clip, report = prepared(
        tiny_source, tmp_path / "clip", body, width=48, every=2, max_frames=4, focal=100.0,
        image_format="png", human_name="man", object_name="ball",
    )  # fmt: skip
    assert (len(clip), clip.cameras[0].width) == (4, 48)
    taken = np.array(clip.provenance["frames"])  # all are as sharp
    assert taken.tolist() == [0, 2, 4, 6] and clip.fps == pytest.approx(6)
    times = [moment.time for moment in clip.moments]
    np.testing.assert_allclose(times, (taken - taken[0]) / (taken[-1] - taken[0]), atol=1e-3)
    assert float(clip.cameras[0].K[0, 0]) == 50
    assert set(clip.kinds) == {"man", "ball"}
    assert not (tmp_path / "clip/overlay.mp4").exists()
    assert (tmp_path / "clip/images/00003.png").is_file()
    assert report.width == 48


def test_what_is_noted_while_frames_are_read_is_a_warning_of_the_report(
    tiny_source: Path, tmp_path: Path, body: AnnyBody, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That a video's index is wrong, say, which shows only then (`test_seeking`)."""
    read = VideoFrames._pictures

    def noting(frames: VideoFrames, first: int = 0) -> Iterator[Picture]:
        frames._note("its index is wrong")
        return read(frames, first)

    monkeypatch.setattr(VideoFrames, "_pictures", noting)
    _, report = prepared(tiny_source, tmp_path / "clip", body, fit_steps=2)
    assert report.warnings.count("its index is wrong") == 1


def test_moving_camera_and_masks_apart(tiny_source: Path, tmp_path: Path, body: AnnyBody) -> None:
    """A COLMAP model of its own unit, masks by entity, no ball: the hands place the object."""
    colmap_model(tiny_source / "sparse", k1=0.0)  # 0.1 units a frame, in truth 0.05 m
    np.savez(tiny_source / "pose_mediapipe.npz", **landmarks(FOCAL, step=0.05))
    (tiny_source / "ball_track.npz").unlink()
    for i in range(FRAMES):
        (tiny_source / f"hoi_mask/{i:05d}.png").unlink()
        for name, mask in zip(("human", "object"), masks(i), strict=True):
            folder = tiny_source / f"masks/{name}"
            folder.mkdir(parents=True, exist_ok=True)
            Image.fromarray(mask).save(folder / f"{i:05d}.png")
    clip, report = prepared(tiny_source, tmp_path / "clip", body, fit_steps=25)
    assert report.camera == "moving" and 0.35 < report.scene_scale < 0.7
    assert (tmp_path / "clip/colmap/cameras.txt").is_file()
    for i in (2, 9):
        assert torch.equal(clip[i].masks["object"], torch.from_numpy(masks(i)[1]))
        xy, depth = clip.cameras[i].project(clip.objects["object"].translations[i])
        assert float(depth) > 0 and np.abs(xy.numpy() - BALL(i)[:2]).max() < 1
    # cameras and points are scaled alike
    step = (clip.cameras[1].center - clip.cameras[0].center).norm()
    assert float(step) == pytest.approx(0.1 * report.scene_scale, rel=1e-3)
    assert float(clip.points[:, 2].max()) == pytest.approx(4 * report.scene_scale, rel=1e-3)


def test_faults_leave_nothing_behind(tiny_source: Path, tmp_path: Path, body: AnnyBody) -> None:
    out = tmp_path / "clip"
    (tiny_source / "hoi_mask/00004.png").unlink()
    with pytest.raises(HoigsError, match=r"hoi_mask.*1 of 12 .*4"):
        prepare(tiny_source, out, body=body)
    np.savez(tiny_source / "pose_mediapipe.npz", image_xyzv=np.zeros((3, 33, 4)))
    with pytest.raises(HoigsError, match=r"image_xyzv.*3 .*12"):
        prepare(tiny_source, out, body=body)
    nobody = np.full((FRAMES, 33, 4), np.nan)
    np.savez(tiny_source / "pose_mediapipe.npz", image_xyzv=nobody, world_xyzv=nobody)
    with pytest.raises(SourceError, match="12 chosen frames"):
        prepare(tiny_source, out, body=body)
    (tiny_source / "video.mp4").write_bytes(b"")
    with pytest.raises(SourceError, match="0 bytes"):
        prepare(tiny_source, out, body=body)
    assert [p.name for p in tmp_path.iterdir()] == ["source"]


def test_targets_are_not_overwritten(tiny_source: Path, tmp_path: Path, body: AnnyBody) -> None:
    out = tmp_path / "clip"
    options = PrepareOptions(max_frames=4, width=48, fit_steps=2, overlay_width=0)
    prepare(tiny_source, out, body=body, options=options)
    with pytest.raises(ClipError, match="--overwrite"):
        prepare(tiny_source, out, body=body, options=options)
    again = options.model_copy(update={"overwrite": True})
    prepare(tiny_source, out, body=body, options=again)
    (out / "notes.txt").write_text("mine")
    with pytest.raises(ClipError, match=r"notes\.txt"):
        prepare(tiny_source, out, body=body, options=again)
    assert (out / "notes.txt").read_text() == "mine"
    (out / "notes.txt").unlink()
    report = prepare(
        tiny_source,
        out,
        options=options,
        max_frames=5,
        overrides=["human_name=she"],
        overwrite=True,
    )
    clip = ClipFolderReader().read(out)
    assert len(clip) == report.frames == 5 and set(clip.kinds) == {"she", "object"}
    assert clip.cameras[0].width == 48, "what stands in options stays"
    with pytest.raises(HoigsError, match=r"body:smplx.*path"):
        prepare(tiny_source, tmp_path / "third", options=options, overrides=["body=body:smplx"])
    assert not (tmp_path / "third").exists()
    with pytest.raises(SourceError, match="is a clip already"):
        prepare(out, tmp_path / "other", body=body)
    with pytest.raises(ClipError, match=r"source.* not empty"):
        prepare(tiny_source, tiny_source, body=body)


@pytest.mark.parametrize(
    ("name", "camera", "spread"), [("juggle", "static", 0.03), ("backpack", "moving", 0.3)]
)
def test_real_videos(
    shared_data: Path, tmp_path: Path, body: AnnyBody, name: str, camera: str, spread: float
) -> None:
    every = 1 if name == "juggle" else 8  # backpack's landmarks begin at frame 25
    clip, report = prepared(
        shared_data / name,
        tmp_path / name,
        body,
        every=every,
        max_frames=8,
        width=320,
        fit_steps=25,
    )
    assert report.camera == camera and report.object_scale_spread < spread
    assert report.body_residual_px < 0.04 * 320
    human, thing = (np.array(report.coverage[n]) for n in ("human", "object"))
    assert (human > 0.05).all() and np.median(thing) > 0.003 and (human.mean() > thing.mean())
    assert report.scene_points > 2000
    # points of the object fall on its mask
    track = clip.objects["object"]
    for i in np.flatnonzero(thing > 0.5 * np.median(thing)).tolist():
        xy, _ = clip.cameras[i].project(
            track.points @ track.rotations[i].mT + track.translations[i]
        )
        column, row = xy.floor().long().T.clamp(min=0)
        mask = clip[i].masks["object"]
        column, row = column.clamp(max=mask.shape[1] - 1), row.clamp(max=mask.shape[0] - 1)
        assert float(mask[row, column].float().mean()) > (0.85 if name == "juggle" else 0.5)


def test_a_body_fitted_in_windows_says_so(
    tiny_source: Path, tmp_path: Path, body: AnnyBody
) -> None:
    _, report = prepared(tiny_source, tmp_path / "clip", body, chunk=8, overlap=4, fit_steps=3)
    assert report.body["windows"] == 2
    ((frame, metres, degrees),) = report.body["joints"]
    assert (frame, metres, degrees) == (6, pytest.approx(0, abs=0.01), pytest.approx(0, abs=2))
    assert "in 2 windows of at most 8 frames with one shape" in report.provenance["body"]
    _, report = prepared(tiny_source, tmp_path / "whole", body, chunk=12, fit_steps=3)
    assert report.provenance["body"].endswith("one window of 12: nothing was split")


def test_what_windows_do_not_bound_is_said(
    tiny_source: Path, tmp_path: Path, body: AnnyBody, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As if the ball had been tracked by texture."""

    def by_texture(*inputs: Any, **settings: Any) -> MadeObject:
        made = make_object(*inputs, **settings)
        outline = np.zeros(FRAMES)
        confidence = replace(made.confidence, way="texture and hands", outline=outline)
        return replace(made, confidence=confidence)

    monkeypatch.setattr(stages, "make_object", by_texture)
    for chunk, count in ((8, 1), (12, 0)):
        out = tmp_path / str(chunk)
        _, report = prepared(tiny_source, out, body, chunk=chunk, overlap=4, fit_steps=3)
        assert sum("tracked by texture in all frames" in text for text in report.warnings) == count


def test_windows_that_cannot_be_joined_are_refused(tiny_source: Path, tmp_path: Path) -> None:
    for settings, said in (
        ({"chunk": 8, "overlap": 6}, "share 4"),
        ({"chunk": 5}, "8 or more"),
        ({"overlap": 6}, "chunk"),
    ):
        with pytest.raises(SpecError, match=said):
            prepare(tiny_source, tmp_path / "clip", **settings)  # type: ignore[arg-type]
        assert not (tmp_path / "clip").exists()


def test_two_frames_are_refused_at_once(tiny_source: Path, tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"mp4: 2 "):
        prepare(tiny_source, tmp_path / "clip", options=PrepareOptions(max_frames=2))
