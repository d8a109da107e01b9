"""The viewer without a browser: clock, sizes, cameras, panes, and what is drawn in each mode."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from hoigs.core.values.between import camera_between, in_shape
from hoigs.core.values.camera import Camera
from hoigs.runs.loaded_run import LoadedRun
from hoigs.viewing.viewer import eyes
from hoigs.viewing.viewer.clip_drawing import ClipDrawing
from hoigs.viewing.viewer.controls import Clock
from hoigs.viewing.viewer.eyes import Eye
from hoigs.viewing.viewer.panes import inner_rectangle, joined
from hoigs.viewing.viewer.run_drawing import FAR, MODES, Look, Resolution, RunDrawing
from hoigs.viewing.viewer.takes import Path as TakenPath
from hoigs.viewing.viewer.takes import turned_to
from hoigs.viewing.viewer.views import View

pytestmark = pytest.mark.usefixtures("one_thread")


def test_the_clock_plays_loops_steps_and_stops() -> None:
    clock = Clock(10, fps=5.0)
    clock.play(100.0)
    assert clock.frame(100.5) == pytest.approx(2.5)  # between frames
    clock.speed = 2.0
    assert clock.frame(101.0) == pytest.approx(7.5)
    assert clock.frame(101.5) == pytest.approx(2.5)  # 12.5 frames, of which there are ten
    clock.step(1, 101.5)
    assert not clock.playing and clock.frame(200.0) == 3.0
    clock.step(-1, 200.0)
    assert clock.frame(200.0) == 2.0
    clock.loop, clock.speed = False, 1.0
    clock.seek(99, 200.0)
    assert clock.frame(200.0) == 9.0
    clock.play(200.0)  # from the start, as it stood at the end
    assert clock.frame(201.0) == pytest.approx(5.0)
    assert clock.frame(300.0) == 9.0 and not clock.playing


def test_a_clip_of_one_frame_can_be_played() -> None:
    clock = Clock(1, fps=30.0)
    clock.play(0.0)
    assert clock.frame(5.0) == 0.0
    clock.step(1, 5.0)
    assert clock.frame(5.0) == 0.0


@pytest.mark.parametrize("fixed, per_megapixel", [(0.01, 0.2), (0.001, 1.0), (0.03, 5.0)])
def test_the_size_settles_within_the_budget(fixed: float, per_megapixel: float) -> None:
    resolution, canvas = Resolution(1280), (1600, 900)
    for _ in range(40):
        size = resolution.size(canvas, moving=True)
        took = fixed + per_megapixel * size[0] * size[1] / 1e6
        resolution.took(took)
    assert took < 0.1 or size[0] == 128
    assert took > 0.04 or size[0] == 1280  # and does not waste it
    assert resolution.size(canvas, moving=False) == (1280, 720)


def test_views_and_cameras_are_the_same() -> None:
    eye, target = torch.tensor((1.0, 2.0, 3.0)), torch.tensor((0.2, 1.0, -0.5))
    camera = Camera.look_at(eye, target, width=320, height=240, fov_y=0.9)
    again = View.of_camera(camera, 2.0, (640, 480)).camera((320, 240))
    assert torch.allclose(again.world_to_camera, camera.world_to_camera, atol=1e-5)
    assert torch.allclose(again.K, camera.K, atol=1e-3)
    turned = turned_to(View.of_camera(camera, 2.0, (320, 240)), np.zeros(3), np.array((0, 1.0, 0)))
    pixel, depth = turned.camera((320, 240)).project(torch.zeros(1, 3))
    assert depth > 0 and torch.allclose(pixel[0], torch.tensor((160.0, 120.0)), atol=1e-2)


def test_a_camera_fitted_into_a_canvas_shows_the_same_in_the_middle() -> None:
    camera = Camera.look_at(
        torch.tensor((0.0, 0.0, -3.0)), torch.zeros(3), width=100, height=50, fov_y=0.8
    )
    points = torch.tensor(((0.1, 0.2, 0.3), (-0.5, 0.1, 0.0)))
    left, top, width, _ = inner_rectangle((100, 50), (300, 300))
    wide = in_shape(camera, 300, 300)
    assert (left, top, width) == (0, 75, 300)
    expected = camera.project(points)[0] * 3 + torch.tensor((0.0, 75.0))
    assert torch.allclose(wide.project(points)[0], expected, atol=1e-3)


def test_panes_put_two_pictures_in_one() -> None:
    def camera_of(size: tuple[int, int]) -> Camera:
        return Camera(torch.eye(3), torch.eye(4), *size)

    def plain(value: int):  # type: ignore[no-untyped-def]
        return lambda camera: np.full((camera.height, camera.width, 3), value, np.uint8)

    beside = joined("beside", 0.5, (41, 8), camera_of, plain(10), plain(90))
    assert (
        beside.shape == (8, 41, 3) and (beside[:, :20] == 10).all() and (beside[:, 21:] == 90).all()
    )
    blend = joined("blend", 0.25, (40, 8), camera_of, plain(10), plain(90))
    assert (blend == 30).all()
    wipe = joined("wipe", 0.75, (40, 8), camera_of, plain(10), plain(90))
    assert (wipe[:, :29] == 10).all() and (wipe[:, 31:] == 90).all()


def test_a_path_passes_through_its_views_and_time_may_stand_still() -> None:
    def at(x: float) -> View:
        camera = Camera.look_at(
            torch.tensor((x, 0.0, -3.0)), torch.zeros(3), width=64, height=64, fov_y=0.8
        )
        return View.of_camera(camera, math.hypot(x, 3), (64, 64))

    path = TakenPath([(4.0, at(-1.0)), (4.0, at(0.0)), (8.0, at(2.0))])
    for share, (frame, view) in zip((0.0, 0.5, 1.0), path.keys, strict=True):
        there = path.at(share)
        assert there[0] == frame and there[1].near(view)
    frame, view = path.at(0.25)
    assert frame == 4.0 and -1.0 < view.position[0] < 0.0
    assert path.at(0.75)[0] == pytest.approx(6.0)


@pytest.fixture(scope="module")
def drawing(tiny_run: Path) -> RunDrawing:
    return RunDrawing(LoadedRun.open(tiny_run, device="cpu"))


def test_every_mode_draws_another_picture(drawing: RunDrawing) -> None:
    camera, everything = drawing.clip.cameras[0], frozenset(drawing.names)
    pictures = [drawing.draw(3.0, camera, Look(mode, everything)).image for mode in MODES]
    for i, picture in enumerate(pictures):
        assert picture.shape == (camera.height, camera.width, 3) and picture.std() > 1
        for other in pictures[:i]:
            assert np.abs(picture.astype(int) - other).mean() > 1
    wide = in_shape(camera, 2 * camera.width, camera.height)
    error = drawing.draw(3.0, wide, Look("error to the video", everything)).image
    assert error[:, : camera.width // 2].max() == 0 < error.max()  # the video does not reach there
    colour = pictures[MODES.index("colour")]
    plain = drawing.loaded.model.render(drawing.clip.moments[3], camera).color
    assert np.abs(colour / 255 - plain.detach().clamp(0, 1).numpy()).max() < 0.01


def test_time_entities_interaction_and_background_change_the_picture(drawing: RunDrawing) -> None:
    camera, everything = drawing.clip.cameras[0], frozenset(drawing.names)
    full = drawing.draw(3.0, camera, Look(entities=everything), depth=True)
    assert full.depth is not None and 0 < np.median(full.depth) < FAR
    between = drawing.draw(3.5, camera, Look(entities=everything)).image
    assert (between != full.image).any()
    for name in drawing.names:
        others = drawing.draw(3.0, camera, Look(entities=everything - {name})).image
        assert np.abs(others.astype(int) - full.image).max() > 20, name
    nothing = drawing.draw(3.0, camera, Look(background=(1.0, 0.0, 0.0))).image
    assert (nothing == (255, 0, 0)).all()
    uncorrected = drawing.gaussians(3.0, interaction=False).means.clone()
    corrected = drawing.gaussians(3.0).means
    assert float((uncorrected - corrected).norm(dim=-1).max()) > 0
    again = drawing.draw(3.0, camera, Look(entities=everything)).image
    assert (again == full.image).all()


def test_a_clip_shows_its_frames_masks_and_depth(drawing: RunDrawing) -> None:
    clip = drawing.clip
    shown, camera = ClipDrawing(clip), camera_between(clip, 2.0)
    frame = shown.draw(2.0, camera, Look("frame")).image
    assert np.abs(frame.astype(int) - clip.store.image(2).numpy()).max() <= 1
    for name in shown.names:
        tinted = shown.draw(2.0, camera, Look("frame and masks", frozenset({name}))).image
        inside = (tinted != frame).any(-1)
        assert inside.any() and not (inside & ~clip.store.mask(name, 2).numpy()).any()
    if clip.depth_kind != "none":
        assert shown.draw(2.0, camera, Look("depth")).image.std() > 1


def test_a_late_answer_of_the_browser_is_no_drag(monkeypatch: pytest.MonkeyPatch) -> None:
    """As Chromium sent them: the camera that was set, its own start, that with another upright."""
    now = [0.0]
    monkeypatch.setattr(eyes, "time", SimpleNamespace(monotonic=lambda: now[0]))
    camera = SimpleNamespace(
        position=np.array((3.0, 3.0, 3.0)), look_at=np.zeros(3), wxyz=np.array((1.0, 0, 0, 0)),
        up_direction=np.array((0.0, 1, 0)), fov=1.0, image_width=64, image_height=48,
    )  # fmt: skip
    drags: list[Eye] = []
    eye = Eye(SimpleNamespace(camera=camera, atomic=nullcontext), 640, drags.append)
    target = np.array((0, 0.8, 0.0))
    goal = View(np.array((-0.8, 1.2, 3.5)), target, np.eye(3), np.array((0.0, 1, 0)), 1.0)

    def sent(position: Sequence[float], at: float) -> None:
        camera.position, now[0] = np.array(position), at
        eye.moved()

    sent((3.0, 3.0, 3.0), 0.0)
    eye.look(goal)
    sent((2.7, 3.5, 2.6), 0.1)
    sent(goal.position, 0.2)
    sent((0.3, -0.8, -4.9), 0.4)
    sent(goal.position + 0.3, 0.5)
    sent((2.7, 3.5, 2.6), 5.0)
    assert not drags
    sent(goal.position, 5.1)
    sent(goal.position + 0.3, 5.2)
    assert drags == [eye]
