"""hoigs view: the page in a browser, a run in training, and what it says to wrong input."""

from __future__ import annotations

import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from served import CAMERA, Visitor, served, visit_of

import hoigs
from hoigs.core.errors import HoigsError

pytest.importorskip("viser", reason="viser is not installed: pip install 'hoigs[view]'")
pytestmark = pytest.mark.usefixtures("one_thread")


def until(check: Callable[[], bool], page: Any, what: str, seconds: float = 40) -> None:
    for _ in range(int(seconds * 5)):
        if check():
            return
        page.wait_for_timeout(200)
    raise AssertionError(f"not within {seconds} s: {what}")


def comes(visitor: Visitor, check: Callable[[], bool], seconds: float = 20) -> None:
    end = time.monotonic() + seconds
    while not check():
        assert time.monotonic() < end
        visitor.listen(0.05)


def test_the_viewer_in_a_browser(tiny_run: Path, window: Any) -> None:
    with served(tiny_run) as (viewer, address, lines):
        assert address.startswith("http://127.0.0.1:") and not any("warning" in x for x in lines)
        opened = window()
        page = opened.page
        page.goto(address)

        def still() -> bool:
            return bool(viewer.visits) and visit_of(viewer).eye.full

        def picture() -> np.ndarray:
            until(still, page, "a still picture")
            page.wait_for_timeout(700)
            return opened.pixels()[:, :280]  # left of the panel

        def another(before: np.ndarray) -> np.ndarray:
            """Once it has come: the old one may have been a still picture, too."""
            until(lambda: np.abs(picture() - before).max() > 30, page, "another picture")
            return picture()

        until(still, page, "the first picture")
        page.wait_for_timeout(3000)  # the notice of software rendering fades in
        first = picture()
        assert first.std() > 5
        page.get_by_role("button", name="frame ▶").click()
        page.wait_for_timeout(500)
        second = picture()
        assert visit_of(viewer).clock.frame(0.0) == 1.0
        page.get_by_role("button", name="Play").click()
        until(lambda: visit_of(viewer).clock.playing, page, "playing")
        page.get_by_role("button", name="Pause").click()
        until(lambda: not visit_of(viewer).clock.playing, page, "the pause")
        visit_of(viewer).clock.seek(6.0, 0.0)
        later = another(second)
        page.get_by_label("human", exact=True).click()
        until(lambda: "human" not in visit_of(viewer).settings.entities, page, "no human")
        alone = another(later)
        assert visit_of(viewer).settings.video

        def dragged() -> bool:  # again where a busy browser took the video's camera once more
            page.mouse.move(150, 300)
            page.mouse.down()
            page.mouse.move(190, 310, steps=5)
            page.mouse.up()
            page.wait_for_timeout(2000)
            return not visit_of(viewer).settings.video and bool(
                np.abs(picture() - alone).max() > 30
            )

        until(dragged, page, "a picture from elsewhere")
        page.get_by_label("body mesh").click()
        until(lambda: "body mesh" in visit_of(viewer).settings.overlays, page, "the body mesh")
        settings = visit_of(viewer).settings
        settings.video = settings.see_through = True  # where the person is seen

        def drawn() -> bool:
            return 0.002 < (np.abs(opened.pixels()[:, :280] - alone).max(-1) > 30).mean() < 0.5

        until(drawn, page, "the body mesh in the place of the hidden person")
        assert opened.errors == []


def test_a_clip_in_a_browser(tiny_run: Path, window: Any) -> None:
    with served(tiny_run.parent / "clip") as (viewer, address, _):
        opened = window()
        page = opened.page
        page.goto(address)
        until(lambda: any(v.eye.full for v in viewer.visits.values()), page, "the frame")
        page.wait_for_timeout(1500)
        tinted = opened.pixels()[:, :280]
        assert tinted.std() > 5
        for name in ("cameras", "scene points", "object points"):
            page.get_by_label(name, exact=True).click()
        until(lambda: len(visit_of(viewer).settings.overlays) == 3, page, "overlays")
        page.wait_for_timeout(1500)
        assert np.abs(opened.pixels()[:, :280] - tinted).max() > 30
        assert opened.errors == []


def test_visitors_have_what_they_chose_and_keys(tiny_run: Path) -> None:
    from hoigs.viewing.viewer.viewer import AROUND

    with served(tiny_run) as (viewer, address, _), Visitor(address) as one, Visitor(address) as two:
        assert one.gets_a_picture() and two.gets_a_picture()
        first, second = viewer.visits.values()
        assert first.settings.follow == "human" and first.settings.video
        one.press(viewer, "human", False)
        commands = first.eye.client.gui._command_handle_from_uuid
        keys = {command.hotkey: uuid for uuid, command in commands.items()}
        one.send(type="CommandTriggerMessage", uuid=keys["arrowright"])
        one.send(type="CommandTriggerMessage", uuid="none")
        comes(one, lambda: first.clock.frame(0.0) == 1.0)
        assert "human" not in first.settings.entities
        assert "human" in second.settings.entities and second.clock.frame(0.0) == 0.0

        wide = viewer.picture((256, 64), viewer.initial(), 0.0, first.eye.view).image
        assert (wide[:, :90] == AROUND).all() and (wide[:, -90:] == AROUND).all()
        assert wide[:, 100:156].std() > 5  # the video's frame is square, and stands in the middle


def test_a_drag_of_a_clip_shows_it_in_3d_above_the_floor(tiny_run: Path) -> None:
    with served(tiny_run.parent / "clip") as (viewer, address, _), Visitor(address) as visitor:
        assert visitor.gets_a_picture()
        (visit,) = viewer.visits.values()
        viewer._dragged(visit)
        wanted = {"body mesh", "object points", "scene points"}
        assert visit.settings.overlays == wanted and not visit.settings.video
        floor, up = viewer.clip.world.floor, viewer.up
        assert floor is not None
        low = (3 * np.eye(3)[2] + (floor - 1) * up).tolist()
        visitor.send(**CAMERA | {"position": low})
        comes(visitor, lambda: float(visit.eye.view.position @ up) > floor)
        visitor.press(viewer, "Camera of the video", True)
        comes(visitor, lambda: visit.settings.video and not visit.settings.overlays)


def test_a_run_in_training_is_followed(tiny_run: Path, tmp_path: Path) -> None:
    run, newest = tmp_path / "run", "step_000004"
    shutil.copytree(tiny_run, run)
    for ending in ("safetensors", "json"):
        (run / "checkpoints" / f"{newest}.{ending}").unlink()
    clip = tiny_run.parent / "clip"
    with served(run, clip=clip) as (viewer, _, lines):
        assert "step 2" in viewer.drawings[0].title
        for ending in ("safetensors", "json"):  # in the order in which training writes them
            name = f"{newest}.{ending}"
            shutil.copy(tiny_run / "checkpoints" / name, run / "checkpoints" / name)
        done = threading.Event()
        for _ in range(100):
            if "step 4" in viewer.drawings[0].title:
                break
            done.wait(0.3)
        assert "step 4" in viewer.drawings[0].title
        assert any(line.endswith("step 4") for line in lines)


def test_two_runs_have_one_clock(tiny_run: Path) -> None:
    with served(tiny_run, tiny_run) as (viewer, _, _):
        from hoigs.viewing.viewer.views import View

        view = View.of_camera(viewer.clip.cameras[0], 2.0, (128, 64))
        both = viewer.picture((128, 64), viewer.initial(), 2.0, view).image.astype(int)
        assert both.shape == (64, 128, 3)
        assert np.abs(both[:, 1:63] - both[:, 65:127]).max() == 0  # the same run on both sides
        assert both.std() > 5


def test_wrong_input_gets_a_sentence(tiny_run: Path, tmp_path: Path) -> None:
    clip = tiny_run.parent / "clip"
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(HoigsError, match="is in use; give another, or --port 0"):
            hoigs.view(clip, port=taken.getsockname()[1])
    with pytest.raises(HoigsError, match="no such folder"):
        hoigs.view(tmp_path / "nothing")
    with pytest.raises(HoigsError, match="this is none"):
        hoigs.view(tiny_run, clip)
    with pytest.raises(HoigsError, match="writes one run"):
        hoigs.view(clip, html=tmp_path / "a.html")
    for option in ({"port": 0}, {"host": "::1"}, {"width": 640}):
        with pytest.raises(HoigsError, match="--html writes a file: leave them out"):
            hoigs.view(tiny_run, html=tmp_path / "a.html", **option)
    with pytest.raises(HoigsError, match="65535"):
        hoigs.view(clip, port=70_000)
    with pytest.raises(HoigsError, match="host"):
        hoigs.view(clip, host="203.0.113.7", port=0)
    bare = tmp_path / "bare"
    shutil.copytree(tiny_run, bare)
    shutil.rmtree(bare / "checkpoints")
    with pytest.raises(HoigsError, match="not a run folder, checkpoints absent"):
        hoigs.view(bare)


def test_other_hosts_are_warned_of(tiny_run: Path) -> None:
    with served(tiny_run.parent / "clip", host="0.0.0.0") as (_, _, lines):
        assert any(line.startswith("warning: anybody who can reach 0.0.0.0") for line in lines)


def test_ctrl_c_ends_it_without_a_traceback(tiny_run: Path) -> None:
    command = [sys.executable, "-m", "hoigs", "view", tiny_run.parent / "clip", "--port=0"]
    process = subprocess.Popen(
        [*map(str, command)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    for line in process.stdout:
        if line.startswith("open http://127.0.0.1:"):
            break
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0 and "stopped" in out
    assert "Traceback" not in err and "viser" not in out


def test_a_training_is_shown_while_it_lasts(tiny_run: Path, tmp_path: Path) -> None:
    """Its viewer answers on loopback, follows the checkpoints, and ends with it after Ctrl-C."""
    run, clip = tmp_path / "run", tiny_run.parent / "clip"
    small = ("train.steps=100000", "model.scene.points=300", "model.human.points=300")
    settings = [f"--set={s}" for s in small]
    command = [sys.executable, "-m", "hoigs", "train", clip, "--out", run, "--view", "--port=0"]
    process = subprocess.Popen(
        [*map(str, command), *settings, "--device=cpu"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        line = next(x for x in process.stdout if x.startswith("view: "))
        address = line.split()[1].rstrip(",")
        assert address.startswith("http://127.0.0.1:")
        assert answers(address, 90)
        assert (run / "checkpoints" / "step_000001.json").exists()
        assert process.poll() is None
    finally:
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
    assert process.returncode == 130 and "hoigs train --resume" in err and "Traceback" not in err
    assert not answers(address, 0)


def answers(address: str, seconds: float) -> bool:
    """Whether a page is served at an address, within this time."""
    import urllib.request

    end = time.monotonic() + seconds
    while True:
        try:
            with urllib.request.urlopen(address, timeout=5) as page:
                return page.status == 200
        except OSError:
            if time.monotonic() > end:
                return False
            time.sleep(0.3)
