"""Eye: one browser that looks at the viewer, its camera, and what it was last sent."""

from __future__ import annotations

import math
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from hoigs.viewing.viewer.run_drawing import Resolution
from hoigs.viewing.viewer.views import View

STILL_S = 0.25  # a picture is drawn in full once nothing has changed for so long
START_S = 2.0  # after a browser's first answer, in which its own start may still come
RETRY_S = 1.0  # after a failure
STEP = 0.6  # of the distance to the target: how far the mouse moves a camera at once, at most


class Eye:
    """One connected browser.

    Args:
        client: viser's handle. widest: pixels of a still picture at most.
        dragged: called when a person moved the camera.

    Attributes:
        resolution: sizes of this canvas. drawn: what was last drawn (any key).
        full: whether that was a still picture, in full size and quality.
        changed: when something last changed, seconds.
        rates: times of the last drawings.
    """

    def __init__(self, client: Any, widest: int, dragged: Callable[[Eye], None]) -> None:
        self.client, self._dragged = client, dragged
        self.resolution = Resolution(widest)
        self.drawn: object = None
        self.full, self.changed = False, 0.0
        self._failure, self._again = "", 0.0
        self.rates: deque[float] = deque(maxlen=20)
        self._set: deque[np.ndarray] = deque(maxlen=400)  # positions of cameras
        self._answered = math.inf  # when the browser first took a camera that was set, seconds
        self._taken = np.zeros(3)  # the position of the last that it took
        self._own: View | None = None  # the last that it had of itself
        self._asked = 0  # how often it had another one of itself

    @property
    def canvas(self) -> tuple[int, int]:
        """Width and height of the browser's picture, pixels."""
        camera = self.client.camera
        return max(int(camera.image_width), 1), max(int(camera.image_height), 1)

    @property
    def view(self) -> View:
        return View.of_client(self.client.camera)

    def look(self, view: View) -> None:
        """Set the browser's camera."""
        self._set.append(view.position)
        with self.client.atomic():
            view.apply(self.client.camera)

    def moved(self) -> None:
        """The browser has sent a camera: `dragged` is called unless it is where one was set.

        A busy browser answers seconds later, and with the position of one camera and the target
        of another, as it takes them one after the other; whatever the mouse does to the camera
        moves its position. Its own start, turned or not by the scene's upright, may still come
        after the first camera that was set: a drag is neither so early nor so far in one step.
        """
        seen, now = self.view, time.monotonic()
        distance = max(float(np.linalg.norm(seen.target - seen.position)), 1e-3)
        apart = np.linalg.norm(np.array(self._set).reshape(-1, 3) - seen.position, axis=1)
        if (apart < 0.01 * distance).any():
            self._answered, self._taken = min(self._answered, now), seen.position
            return
        if self._own is None or not seen.near(self._own):
            self._asked += 1
        self._own = seen
        near = np.linalg.norm(seen.position - self._taken) < STEP * distance
        if near and now - self._answered > START_S:
            self._dragged(self)

    @contextmanager
    def apart(self) -> Iterator[None]:
        """An exception in this block is shown in this browser, and does not stop the others."""
        try:
            yield
        except Exception as error:
            self._again = time.monotonic() + RETRY_S
            text = f"{type(error).__name__}: {error}"
            if text != self._failure:  # not at every try
                self._failure = text
                traceback.print_exc()
                self.client.add_notification("This cannot be drawn", text, color="red")

    def ready(self, now: float) -> bool:
        """Whether to draw for it: not just after a failure."""
        return now >= self._again

    def rate(self) -> float:
        """Pictures a second over the last ones; 0 with fewer than three."""
        times = list(self.rates)
        span = times[-1] - times[0] if len(times) > 2 else 0.0
        return (len(times) - 1) / span if span > 0 else 0.0

    def pose_key(self) -> tuple[object, ...]:
        """The camera and the canvas, rounded, to notice changes; who asks from elsewhere, where the
        camera is the video's, gets that picture again."""
        view = self.view
        numbers = np.concatenate((view.position, view.rotation.ravel(), [view.fov]))
        return (self.canvas, self._asked, *np.round(numbers, 5).tolist())
