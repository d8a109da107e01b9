"""The screenshots of docs/howto/view.md, made by a headless Chromium.

    python scripts/view_pictures.py RUN [run modes clip file two=RUN2]      # for example runs/demo

Needs the extras of dev (playwright) and Chromium in PATH. Writes docs/assets/view-*.webp.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
import threading
from io import BytesIO
from pathlib import Path
from typing import Any

from PIL import Image
from playwright.sync_api import Page, sync_playwright

import hoigs
from hoigs.runs.run_folder import RunFolder
from hoigs.viewing.viewer.run_drawing import MODES

ASSETS = Path(__file__).resolve().parents[1] / "docs" / "assets"
SLOW_MS = 240_000  # software rendering on a busy machine
SIZE = {"width": 1200, "height": 760}
SOFTWARE = (
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)


def shot_of(page: Page) -> Image.Image:
    return Image.open(BytesIO(page.screenshot(timeout=SLOW_MS))).convert("RGB")


def save(shot: Image.Image, name: str) -> None:
    shot = shot.resize((900, round(900 * shot.height / shot.width)), Image.Resampling.LANCZOS)
    shot.save(ASSETS / f"view-{name}.webp", quality=80)
    print(f"view-{name}.webp: {(ASSETS / f'view-{name}.webp').stat().st_size // 1000} kB")


class Served:
    """`hoigs view` in a thread."""

    def __init__(self, *what: Path) -> None:
        self.ready, self.lines = threading.Event(), list[str]()
        self.thread = threading.Thread(target=self._work, args=what)
        self.thread.start()
        self.ready.wait()
        self.address = next(line.split()[1] for line in self.lines if line.startswith("open"))

    def _work(self, *what: Path) -> None:
        try:
            hoigs.view(*what, port=0, report=self.lines.append, started=self._started)
        finally:
            self.ready.set()  # also where it failed: then there is no address

    def _started(self, viewer: Any) -> None:
        self.viewer = viewer
        self.ready.set()

    @property
    def visit(self) -> Any:
        """The one visitor."""
        return next(iter(self.viewer.visits.values()))

    def settle(self, page: Page) -> None:
        """Wait for a still picture."""
        page.wait_for_timeout(4000)  # a busy machine notices a change late
        while not all(visit.eye.full for visit in self.viewer.visits.values()):
            page.wait_for_timeout(200)
        page.wait_for_timeout(1500)

    def open(self, browser: Any) -> Page:
        """A page with the moment in the middle, still."""
        page: Page = browser.new_page(viewport=SIZE)
        page.goto(self.address)
        while not self.viewer.visits:
            page.wait_for_timeout(200)
        page.wait_for_timeout(5000)
        page.add_style_tag(content=".mantine-Notifications-root { display: none; }")
        self.visit.clock.seek(0.5 * self.visit.clock.last, 0.0)
        self.settle(page)
        return page

    def close(self) -> None:
        self.viewer.stop()
        self.thread.join()


def drag(page: Page, dx: int, dy: int) -> None:
    page.mouse.move(400, 380)  # left of the panel
    page.mouse.down()
    page.mouse.move(400 + dx, 380 + dy, steps=6)
    page.mouse.up()


def of_run(browser: Any, run: Path) -> None:
    served = Served(run)
    page = served.open(browser)
    viewer = served.visit
    with viewer.controls.lock:
        viewer.settings.layout, viewer.settings.share = "wipe", 0.32
    served.settle(page)
    save(shot_of(page), "wipe")
    with viewer.controls.lock:
        viewer.settings.layout = "one"
    drag(page, 36, 20)
    served.settle(page)
    save(shot_of(page), "run")
    with viewer.controls.lock:
        viewer.settings.entities.discard("human")
        viewer.settings.overlays.update(("body mesh", "object track"))
    served.settle(page)
    save(shot_of(page), "overlays")
    served.close()


def of_modes(browser: Any, run: Path) -> None:
    """All modes but colour in one picture, without the panel."""
    served = Served(run)
    page = served.open(browser)
    cells = []
    for mode in MODES[1:]:
        with served.visit.controls.lock:
            served.visit.settings.mode = mode
        served.settle(page)
        width, height = served.visit.eye.canvas
        left = (width - height) // 2  # the frame is square
        cells.append(shot_of(page).crop((left, 0, left + height, height)).resize((360, 360)))
    sheet = Image.new("RGB", (360 * len(cells), 360))
    for i, cell in enumerate(cells):
        sheet.paste(cell, (360 * i, 0))
    save(sheet, "modes")
    served.close()


def of_two(browser: Any, run: Path, second: Path) -> None:
    served = Served(run, second)
    page = served.open(browser)
    drag(page, 30, 10)
    served.settle(page)
    save(shot_of(page), "two")
    served.close()


def of_clip(browser: Any, clip: Path) -> None:
    served = Served(clip)
    page = served.open(browser)
    with served.visit.controls.lock:
        served.visit.settings.overlays.update(("skeleton", "object track"))
    served.settle(page)
    save(shot_of(page), "clip")
    served.close()


def of_file(browser: Any, run: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        made = hoigs.view(run, html=Path(folder) / "run.html")
        print(made)
        page = browser.new_context(viewport=SIZE, offline=True).new_page()
        page.goto(made.path.as_uri())
        while not page.evaluate("window.drawn > 0"):  # its policy forbids wait_for_function
            page.wait_for_timeout(200)
        page.evaluate("(() => { const t = document.getElementById('time'); t.value = t.max / 2;"
                      " t.oninput({target: t}); })()")  # fmt: skip
        page.wait_for_timeout(2000)
        drag(page, 60, 10)
        page.wait_for_timeout(3000)
        save(shot_of(page), "html")


def main() -> None:
    run = Path(sys.argv[1])
    clip = (run / RunFolder(run).read_provenance()["clip"]["path"]).resolve()
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=shutil.which("chromium"), args=[*SOFTWARE])
        made = {"file": of_file, "clip": of_clip, "run": of_run, "modes": of_modes}
        for part in sys.argv[2:] or made:
            if part.startswith("two="):
                of_two(browser, run, Path(part.removeprefix("two=")))
            else:
                made[part](browser, clip if part == "clip" else run)
        browser.close()


if __name__ == "__main__":
    main()
