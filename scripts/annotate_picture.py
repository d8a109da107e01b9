"""The picture of docs/howto/annotate.md: a video in the page, clicked on and tracked.

    python scripts/annotate_picture.py VIDEO 653,324@0 749,557@30 --set max_frames=36

It needs playwright and a Chromium in PATH, or named by HOIGS_CHROMIUM.
"""

from __future__ import annotations

import argparse
import io
import os
import shutil
import tempfile
import threading
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

from hoigs.viewing.annotate.server import PageServer, annotate

TARGET = Path(__file__).parents[1] / "docs" / "assets" / "annotate.webp"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("video", type=Path)
    parser.add_argument("clicks", nargs="+", help="X,Y@FRAME, the object's")
    parser.add_argument("--set", action="append", default=[], help="option of prepare")
    parser.add_argument("--frame", type=int, default=12, help="frame to show at the end")
    parser.add_argument("--out", type=Path, default=TARGET)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        video = Path(folder) / given.video.name
        shutil.copy(given.video, video)
        got: list[PageServer] = []
        ready = threading.Event()

        def started(server: PageServer) -> None:
            got.append(server)
            ready.set()

        options = {"out": Path(folder) / "clip", "port": 0, "overrides": given.set}
        work = threading.Thread(
            target=annotate, args=(video,), kwargs={**options, "started": started}
        )
        work.start()
        ready.wait()
        try:
            save(picture(got[0].address, given.clicks, given.frame), given.out)
        finally:
            got[0].shutdown()
            work.join()


def picture(address: str, clicks: list[str], frame: int) -> bytes:
    """A screenshot after clicks and tracking."""
    found = os.environ.get("HOIGS_CHROMIUM") or shutil.which("chromium")
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=found, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1280, "height": 760})
        page.goto(address)
        wait(page, "frames.size > 0")
        for text in clicks:
            place, at = text.split("@")
            x, y = map(float, place.split(","))
            page.evaluate("n => go(n)", int(at))
            wait(page, "frames.has(frame)")
            p = page.evaluate("place()")
            position = {"x": p["x"] + x * p["s"], "y": p["y"] + y * p["s"]}
            page.locator("#view").click(position=position)
            wait(page, "masks.get(maskKey(entity(), frame))")
        page.get_by_role("button", name="Track").click()
        wait(page, "job.state && job.state !== 'running'")
        page.evaluate("document.getElementById('out').value = 'clips/mine'")
        page.evaluate("n => go(n)", frame)
        wait(page, "frames.has(frame) && !working")
        page.wait_for_timeout(1500)
        shot = page.screenshot()
        browser.close()
        return shot


def wait(page: Page, script: str) -> None:
    """Until it is so, or 10 minutes."""
    for _ in range(3000):
        if page.evaluate(f"Boolean({script})"):
            return
        page.wait_for_timeout(200)
    raise TimeoutError(script)


def save(shot: bytes, path: Path) -> None:
    Image.open(io.BytesIO(shot)).convert("RGB").save(path, quality=82, method=6)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
