"""A headless Chromium, for tests of what is seen: fixtures of tests/conftest.py."""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import pytest

T = TypeVar("T")


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    """A browser, by playwright; HOIGS_CHROMIUM names one that is not in PATH."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    found = os.environ.get("HOIGS_CHROMIUM") or next(
        filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
    )
    if found is None:
        pytest.skip("no Chromium in PATH, and HOIGS_CHROMIUM is not set")
    software = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
    with playwright.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=found, args=["--no-sandbox", *software])
        yield browser
        browser.close()


class Window:
    """A page of the browser that collects the errors of its console."""

    def __init__(self, browser: Any, **context: Any) -> None:
        self.context = browser.new_context(viewport={"width": 640, "height": 480}, **context)
        self.page = self.context.new_page()
        self.errors: list[str] = []
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("console", lambda m: self.errors.append(m.text) if m.type == "error" else None)

    def pixels(self) -> Any:
        """The window as RGB, [H, W, 3] in [0, 255]."""
        from io import BytesIO

        import numpy as np
        from PIL import Image

        shot = Image.open(BytesIO(self.page.screenshot())).convert("RGB")
        return np.asarray(shot).astype(np.float64)


@pytest.fixture
def window(chromium: Any) -> Iterator[Any]:
    """Makes windows, and closes them after the test."""
    opened: list[Window] = []

    def make(**context: Any) -> Window:
        opened.append(Window(chromium, **context))
        return opened[-1]

    yield make
    for one in opened:
        one.context.close()


@contextmanager
def in_thread(
    serve: Callable[[Callable[[T], None]], None], stop: Callable[[T], None]
) -> Iterator[T]:
    """The server that `serve` gives to its argument, while it runs in a thread.

    Its own errors, and a server that does not end when it is stopped, fail the test.
    """
    got: list[T] = []
    failed: list[BaseException] = []
    ready = threading.Event()

    def started(server: T) -> None:
        got.append(server)
        ready.set()

    def work() -> None:
        try:
            serve(started)
        except BaseException as error:
            failed.append(error)
        finally:
            ready.set()

    thread = threading.Thread(target=work)
    thread.start()
    assert ready.wait(120) and got, failed
    try:
        yield got[0]
    finally:
        stop(got[0])
        thread.join(30)
    assert not thread.is_alive() and not failed, failed
