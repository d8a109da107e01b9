"""Controls: the panel of the viewer, which writes Settings and the clock."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from hoigs.viewing.viewer.panes import Layout
from hoigs.viewing.viewer.run_drawing import Drawing, Look

# Clock: which frame is shown at a wall-clock time; play, pause, speed, loop and steps.


class Clock:
    """The time slider of a viewer. It may stand between frames.

    Args:
        frames: of the clip, numbered from 0. fps: frames a second at speed 1.

    Attributes:
        playing: whether time passes. speed: in parts of real time. loop: begin again at the end;
            otherwise playback stops at the last frame.
    """

    def __init__(self, frames: int, fps: float) -> None:
        self.last, self.fps = max(frames - 1, 0), fps
        self.playing, self.speed, self.loop = False, 1.0, True
        self._frame, self._since = 0.0, 0.0

    def frame(self, now: float) -> float:
        """The frame number at `now`, seconds of any steady clock; between frames a fraction."""
        if self.playing:
            passed = self._frame + (now - self._since) * self.fps * self.speed
            self._since = now
            if passed > self.last and not self.loop:
                self._frame, self.playing = float(self.last), False
            elif self.last == 0:
                self._frame = 0.0
            else:  # the last frame is shown as long as any other
                self._frame = min(passed % (self.last + 1), float(self.last) + 0.999)
        return min(self._frame, float(self.last))

    def play(self, now: float) -> None:
        """Start; from the first frame if the last one is shown and `loop` is off."""
        if not self.loop and self._frame >= self.last:
            self._frame = 0.0
        self.playing, self._since = True, now

    def pause(self, now: float) -> None:
        self._frame = self.frame(now)
        self.playing = False

    def seek(self, frame: float, now: float) -> None:
        """Go to a frame number, which is clamped to the clip; playing goes on from there."""
        self._frame, self._since = min(max(frame, 0.0), float(self.last)), now

    def step(self, by: int, now: float) -> None:
        """Pause at the next whole frame forwards (1) or backwards (-1)."""
        here = self.frame(now)
        self.playing = False
        goal = math.floor(here) + 1 if by > 0 else math.ceil(here) - 1
        self.seek(goal % (self.last + 1) if self.loop else goal, now)


# Settings: what a person has chosen in the panel; the drawing thread reads it.


@dataclass
class Settings:
    """Every control but the clock's.

    Attributes:
        mode, entities, interaction, background: as in `Look`.
        layout, other: how a second picture is shown, and which: "video" or "run".
        share: see `panes.joined`.
        video: whether the camera is the video's; a drag of the mouse ends it.
        follow: an entity that the camera moves along with, or None.
        overlays: names that are switched on. see_through: draw them over everything.
    """

    mode: str
    entities: set[str]
    interaction: bool = True
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    layout: Layout = "one"
    other: str = "video"
    share: float = 0.5
    video: bool = True
    follow: str | None = None
    overlays: set[str] = field(default_factory=set)
    see_through: bool = False

    @property
    def look(self) -> Look:
        return Look(self.mode, frozenset(self.entities), self.interaction, self.background)

    @property
    def needs_video(self) -> bool:
        """Whether what is shown exists only from the camera of the video."""
        compared = self.layout != "one" and self.other == "video"
        return compared or self.mode == "error to the video"

    def key(self) -> tuple[object, ...]:
        """Everything that changes the picture."""
        return (
            self.look, self.layout, self.other, self.share, self.video, self.see_through,
            frozenset(self.overlays),
        )  # fmt: skip


COMPARE: dict[str, tuple[Layout, str]] = {
    "nothing": ("one", "video"),
    "video, beside": ("beside", "video"),
    "video, wipe": ("wipe", "video"),
    "video, blend": ("blend", "video"),
}
WITH_RUN: dict[str, tuple[Layout, str]] = {
    "second run, beside": ("beside", "run"),
    "second run, wipe": ("wipe", "run"),
    "second run, blend": ("blend", "run"),
}


class Controls:
    """The panel. Callbacks of viser's threads change `settings` and `clock` under `lock`.

    Args:
        gui: viser's. drawing: gives modes and entities. overlays: names on offer.
        wake: called after every change. act: called with the name of a button that was pressed:
            "screenshot", "add key", "clear keys", "film".
        folded: all folders are in one that is closed at first, so that on a phone the panel does
            not cover the picture.
    """

    def __init__(
        self,
        gui: Any,
        drawing: Drawing,
        settings: Settings,
        clock: Clock,
        overlays: Sequence[str],
        *,
        wake: Callable[[], None],
        act: Callable[[str], None],
        folded: bool = False,
    ) -> None:
        self.gui, self.settings, self.clock = gui, settings, clock
        self._wake, self._act = wake, act
        self.lock = threading.RLock()
        self._sent_at, self._sent_frame = 0.0, -1.0
        self._folded, self._boxes = folded, dict[str, Any]()
        self._drawer: Any = None
        self._instead = set[str]()  # overlays that stand in for the video's frames
        self.status = gui.add_markdown("connecting …")
        self._time()
        self._picture(drawing, settings.other == "run")
        self._camera(drawing)
        self._overlays(overlays)
        self._takes(drawing)

    def _folder(self, label: str) -> Any:
        if not self._folded:
            return self.gui.add_folder(label)
        if self._drawer is None:
            self._drawer = self.gui.add_folder("More", expand_by_default=False)
        with self._drawer:
            return self.gui.add_folder(label, expand_by_default=False)

    def _time(self) -> None:
        gui, clock = self.gui, self.clock
        self.frame = gui.add_slider("Frame", 0.0, float(max(clock.last, 1)), 0.05, 0.0)
        self.play = gui.add_button("Play", icon="player-play", hint="Space")
        with self._folder("Time"):
            steps = gui.add_button_group("Step", ("◀ frame", "frame ▶"))
            speed = gui.add_slider("Speed", 0.1, 4.0, 0.1, 1.0)
            loop = gui.add_checkbox("Loop", clock.loop)
        now = time.monotonic

        def press(_: Any) -> None:
            (clock.pause if clock.playing else clock.play)(now())

        def step(event: Any) -> None:
            clock.step(-1 if event.target.value.startswith("◀") else 1, now())

        def faster(event: Any) -> None:
            clock.seek(clock.frame(now()), now())
            clock.speed = event.target.value

        def looped(event: Any) -> None:
            clock.loop = event.target.value

        def seek(event: Any) -> None:
            if event.client is not None:  # not by the server itself
                clock.seek(event.target.value, now())

        keys = (("Play or pause", "space", press),
                ("Next frame", "arrowright", lambda _: clock.step(1, now())),
                ("Frame before", "arrowleft", lambda _: clock.step(-1, now())))  # fmt: skip
        for label, key, change in keys:
            gui.add_command(label, hotkey=key).on_trigger(self._locked(change))
        self.play.on_click(self._locked(press))
        steps.on_click(self._locked(step))
        speed.on_update(self._locked(faster))
        loop.on_update(self._locked(looped))
        self.frame.on_update(self._locked(seek))

    def _picture(self, drawing: Drawing, second: bool) -> None:
        gui, settings = self.gui, self.settings
        choices = COMPARE | (WITH_RUN if second else {})
        with self._folder("Picture"):
            mode = gui.add_dropdown("Show", drawing.modes, initial_value=settings.mode)
            self._bind(mode, "mode")
            for name in drawing.names:
                box = gui.add_checkbox(name, name in settings.entities)
                box.on_update(self._toggle(settings.entities, name))
            if drawing.has_interaction:
                self._bind(gui.add_checkbox("interaction", settings.interaction), "interaction")
            if drawing.anywhere:
                given = (settings.layout, settings.other)
                start = next(name for name, choice in choices.items() if choice == given)
                compare = gui.add_dropdown("Beside", tuple(choices), initial_value=start)
                self._bind(gui.add_slider("Wipe or blend", 0.0, 1.0, 0.01, settings.share), "share")
                paint = gui.add_rgb("Background", (0, 0, 0))

                def chosen(event: Any) -> None:
                    settings.layout, settings.other = choices[event.target.value]

                def painted(event: Any) -> None:
                    r, g, b = (channel / 255 for channel in event.target.value)
                    settings.background = (r, g, b)

                compare.on_update(self._locked(chosen))
                paint.on_update(self._locked(painted))

    def _camera(self, drawing: Drawing) -> None:
        gui, settings = self.gui, self.settings
        moving = [name for name in drawing.names if name != "scene"]
        with self._folder("Camera"):
            self.video = gui.add_checkbox(
                "Camera of the video", settings.video, hint="A drag of the mouse ends it."
            )
            self.follow = gui.add_dropdown(
                "Orbit about", ("free", *moving), initial_value=settings.follow or "free"
            )

        def follow(event: Any) -> None:
            settings.follow = None if event.target.value == "free" else event.target.value
            if settings.follow and self.video.value:
                self.leave_video()

        def video(event: Any) -> None:
            settings.video = event.target.value
            if settings.video:
                self._show(self._instead, False)

        self.video.on_update(self._locked(video))
        self.follow.on_update(self._locked(follow))

    def _overlays(self, names: Sequence[str]) -> None:
        gui, settings = self.gui, self.settings
        with self._folder("In 3D"):
            through = gui.add_checkbox(
                "See through", settings.see_through, hint="Draw what follows over everything."
            )
            self._bind(through, "see_through")
            for name in names:
                box = self._boxes[name] = gui.add_checkbox(name, name in settings.overlays)
                box.on_update(self._toggle(settings.overlays, name))
                if name == "skeleton":  # it lies inside of the person
                    box.on_update(lambda event: _set(through, event.target.value or through.value))

    def _takes(self, drawing: Drawing) -> None:
        gui = self.gui
        with gui.add_folder("Take away", expand_by_default=False):
            self._button("Screenshot", "camera", "screenshot")
            if drawing.anywhere:
                self._button("Add this view to the path", "plus", "add key")
                self._button("Clear the path", "trash", "clear keys")
                self.seconds = gui.add_slider("Seconds of film", 1.0, 20.0, 0.5, 4.0)
                self.keys = gui.add_markdown("The path has no view yet.")
                self._button("Film the path (mp4)", "movie", "film")

    def _button(self, label: str, icon: str, action: str) -> None:
        button = self.gui.add_button(label, icon=icon)
        button.on_click(lambda _: self._act(action))

    def leave_video(self, instead: Iterable[str] = ()) -> None:
        """End "camera of the video", and show these overlays until it is back."""
        with self.lock:
            self.settings.video = False
            self.video.value = False
            self._instead = {n for n in instead if n in self._boxes} - self.settings.overlays
            self._show(self._instead, True)

    def _show(self, names: Iterable[str], on: bool) -> None:
        for name in names:
            (self.settings.overlays.add if on else self.settings.overlays.discard)(name)
            self._boxes[name].value = on

    def show_time(self, frame: float, now: float) -> None:
        """Bring slider and button in line with the clock, ten times a second at most."""
        label = "Pause" if self.clock.playing else "Play"
        if self.play.label != label:
            self.play.label = label
            self.play.icon = "player-pause" if self.clock.playing else "player-play"
        if frame != self._sent_frame and (now - self._sent_at > 0.1 or not self.clock.playing):
            self._sent_at, self._sent_frame = now, frame
            self.frame.value = round(frame, 2)

    def _bind(self, handle: Any, name: str) -> None:
        """A control that sets one field of the settings."""

        def changed(event: Any) -> None:
            setattr(self.settings, name, event.target.value)

        handle.on_update(self._locked(changed))

    def _toggle(self, chosen: set[str], name: str) -> Callable[[Any], None]:
        def changed(event: Any) -> None:
            (chosen.add if event.target.value else chosen.discard)(name)

        return self._locked(changed)

    def _locked(self, change: Callable[[Any], None]) -> Callable[[Any], None]:
        def callback(event: Any) -> None:
            with self.lock:
                change(event)
            self._wake()

        return callback


def _set(handle: Any, value: Any) -> None:
    handle.value = value
