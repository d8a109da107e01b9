"""hoigs annotate: the page in a browser, from a click to a clip; and who may use its server."""

from __future__ import annotations

import http.client
import json
import shutil
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import in_thread
from PIL import Image
from tiny import BALL, FRAMES, landmarks, masks, picture

from hoigs.core.clip_folder.check import check_clip
from hoigs.core.errors import HoigsError
from hoigs.preparation.options import PrepareOptions
from hoigs.preparation.report.overlay import VideoWriter
from hoigs.viewing.annotate.server import PageServer, annotate

QUICK = (  # what is tested here is neither the fit nor the scene
    "fit_steps=2", "overlay_width=0", "object_track=outline", "scene_points=200", "camera=static",
    "max_frames=6",
)  # fmt: skip


@pytest.fixture
def video(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The tiny scene with files of the person, so that only the object has to be found."""
    monkeypatch.setenv("HOIGS_CACHE", str(tmp_path / "cache"))  # where MediaPipe is not installed
    folder = tmp_path / "source"
    (folder / "masks" / "human").mkdir(parents=True)
    with VideoWriter(folder / "my.mp4", fps=12, crf=8) as out:
        for i in range(FRAMES):
            out.add(picture(i))
            Image.fromarray(masks(i)[0]).save(folder / f"masks/human/{i:05d}.png")
    np.savez(folder / "pose_mediapipe.npz", **landmarks())
    return folder / "my.mp4"


def served(video: Path, **options: Any) -> AbstractContextManager[PageServer]:
    def serve(started: Callable[[PageServer], None]) -> None:
        annotate(video, port=0, report=lambda line: None, started=started, **options)

    return in_thread(serve, PageServer.shutdown)


def until(check: Callable[[], Any], page: Any, what: str, seconds: float = 60) -> Any:
    for _ in range(int(seconds * 10)):
        if found := check():
            return found
        page.wait_for_timeout(100)
    state = page.evaluate("[$('hint').textContent, working, frame, said(), [...masks.entries()]]")
    raise AssertionError(f"not within {seconds} s: {what}; {state}")


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def test_from_a_click_to_a_clip(video: Path, tmp_path: Path, window: Any) -> None:
    stored, clip = video.with_name("my.prompts.json"), tmp_path / "clip"

    def prompts() -> Any:
        return json.loads(stored.read_text())["object"] if stored.exists() else []

    with served(video, out=clip, options=PrepareOptions(overrides=QUICK)) as server:
        opened = window()
        page = opened.page
        page.set_viewport_size({"width": 1000, "height": 640})
        page.goto(server.address)
        until(lambda: page.evaluate("frames.has(0)"), page, "the first frame")

        def click(x: float, y: float, **how: Any) -> None:
            box, at = page.locator("#view").bounding_box(), page.evaluate("place()")
            page.locator("#view").click(
                position={"x": at["x"] + x * at["s"], "y": at["y"] + y * at["s"]}, **how
            )
            assert box is not None

        def mask_of(frame: int) -> np.ndarray:
            """What the page got as the mask, by its opacity."""
            alpha = page.evaluate(
                """frame => { const e = entity(), m = masks.get(maskKey(e, frame));
                if (!m) return null;
                const c = new OffscreenCanvas(m.width, m.height).getContext("2d");
                c.drawImage(m, 0, 0);
                const all = c.getImageData(0, 0, m.width, m.height).data;
                return [...all].filter((_, i) => i % 4 === 3); }""", frame,
            )  # fmt: skip
            return np.zeros(0, bool) if alpha is None else np.array(alpha).reshape(64, 96) > 127

        bare = opened.pixels()
        click(*BALL(0)[:2])
        until(lambda: mask_of(0).any(), page, "the mask of a click")
        first = mask_of(0)
        assert overlap(first, masks(0)[1]) > 0.6
        page.wait_for_timeout(150)
        assert (np.abs(opened.pixels() - bare).max(-1) > 20).mean() > 0.005
        until(lambda: len(prompts()) == 1, page, "the stored click")
        click(5, 5, button="right")
        until(lambda: len(prompts()) == 2, page, "a click beside it")
        assert prompts()[1].startswith("-5,")
        page.keyboard.press("Control+z")
        until(lambda: len(prompts()) == 1, page, "undo")
        page.keyboard.press("Control+Shift+z")
        until(lambda: len(prompts()) == 2, page, "redo")
        page.evaluate("go(5)")
        box = [BALL(5)[0] - 10, BALL(5)[1] - 10, BALL(5)[0] + 10, BALL(5)[1] + 10]
        at, view = page.evaluate("place()"), page.locator("#view").bounding_box()
        left, top = view["x"] + at["x"], view["y"] + at["y"]
        page.mouse.move(left + box[0] * at["s"], top + box[1] * at["s"])
        page.mouse.down()
        page.mouse.move(left + box[2] * at["s"], top + box[3] * at["s"], steps=3)
        page.mouse.up()
        until(lambda: len(prompts()) == 3, page, "a box")
        assert prompts()[2].endswith("@5") and prompts()[2].count(",") == 3
        name = page.get_by_label("name")
        name.fill("a ball")
        name.press("Enter")
        assert "cannot be a name" in page.locator("#hint").inner_text()
        page.get_by_label("name").fill("ball")
        page.get_by_label("name").press("Enter")
        until(lambda: all(p.startswith("ball=") for p in prompts()), page, "the name")
        page.get_by_role("button", name="Prepare").click()
        until(lambda: page.evaluate("job.state") not in (None, "running"), page, "a clip", 120)
        assert page.evaluate("[job.state, job.error]") == ["finished", None]
        assert any("my.prompts.json" in note for note in page.evaluate("job.notes"))
        until(lambda: page.evaluate("tracked?.names.has('ball')"), page, "tracked masks")
        page.evaluate("go(3)")
        until(lambda: mask_of(3).any(), page, "a tracked mask")
        assert overlap(mask_of(3), masks(3)[1]) > 0.6
        assert check_clip(clip) == [] and "ball" in (clip / "clip.json").read_text()
        assert page.get_by_role("link", name="Open the report").is_visible()
        assert opened.errors == []
        page.reload()
        until(lambda: page.evaluate("frames.size"), page, "the page again")
        assert page.evaluate("entities[0].name") == "ball"
        assert page.evaluate("entities[0].marks.length") == 3


def test_only_its_own_page_is_answered(video: Path) -> None:
    with served(video) as server:
        address, token = server.hosts[0], server.token

        def status(path: str, body: bytes | None = None, **headers: str) -> int:
            connection = http.client.HTTPConnection(address, timeout=20)
            named = {k.replace("_", "-"): v for k, v in headers.items()}
            connection.request("GET" if body is None else "POST", path, body, named)
            answer = connection.getresponse()
            answer.read()
            connection.close()
            return answer.status

        kind = {"Content_Type": "application/json"}
        assert status(f"/{token}/about") == 200
        assert status(f"/{token}/about", Host="elsewhere.example") == 403  # a rebound name
        assert status(f"/{token}/about", Origin="http://elsewhere.example") == 403
        assert status(f"/{token}/about", Sec_Fetch_Site="cross-site") == 403
        assert status(f"/{token[:-1]}/about") == status("/") == 403
        assert status(f"/{token}/prompts", b"[]", Content_Type="text/plain") == 400
        assert status(f"/{token}/prompts", b"[]", **kind) == 200
        assert status(f"/{token}/prompts", b'[{"kind": "object", "name": "../x"}]', **kind) == 400
        assert status(f"/{token}/prompts", b"[" * 200_000, **kind) == 400
        assert status(f"/{token}/frame/99/96") == 409
        assert status(f"/{token}/report/..%2Fsource%2Fmy.mp4") == 404
        assert not video.with_name("my.prompts.json").exists()
        with pytest.raises(HoigsError, match="cannot be used"):
            annotate(video, port=server.server_port)


def test_a_damaged_prompt_file_is_named(video: Path, tmp_path: Path) -> None:
    video.with_name("my.prompts.json").write_text('{"version": 1, "object": ["3,4')
    with pytest.raises(HoigsError, match=r"my\.prompts\.json is not readable as JSON"):
        annotate(video, port=0)
    other = tmp_path / "notes.mp4"
    shutil.copy(__file__, other)
    with pytest.raises(HoigsError, match=r"notes\.mp4 .*is not a readable video"):
        annotate(other, port=0)


def test_the_page_fits_a_phone(video: Path, tmp_path: Path, window: Any) -> None:
    """It is no wider than the window, and the video takes all of that."""
    with served(video, out=tmp_path / "clip") as server:
        page = window().page
        page.set_viewport_size({"width": 390, "height": 844})
        page.goto(server.address)
        until(lambda: page.evaluate("frames.has(0)"), page, "the first frame")
        wide = "document.documentElement.scrollWidth"
        assert page.evaluate(wide) <= 390
        assert page.evaluate("$('view').getBoundingClientRect().width") >= 380
