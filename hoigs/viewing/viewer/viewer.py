"""Viewer: draws for every connected browser what its panel asks for."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import UInt8

from hoigs.core.values.between import camera_between, frame_of, moment_between
from hoigs.core.values.camera import Camera
from hoigs.viewing.viewer import takes
from hoigs.viewing.viewer.controls import Clock, Controls, Settings
from hoigs.viewing.viewer.eyes import STILL_S, Eye
from hoigs.viewing.viewer.overlays import Overlays, PosedBody
from hoigs.viewing.viewer.panes import fitted, joined, source_frame
from hoigs.viewing.viewer.run_drawing import Drawing, Picture, RunDrawing
from hoigs.viewing.viewer.views import View

IDLE_S = 0.05  # between looks at the clock and the cameras while nothing happens
DEPTH_WIDTH = 400  # pixels of the depth that is sent, which hides overlays behind the picture
JPEG = {True: 80, False: 93}  # quality of a moving and of a still picture


class Viewer:
    """One server, its panel, and the thread that draws (the one that calls `serve`).

    Args:
        server: viser's. drawings: one or two; the clock is that of the first one's clip.
        bodies: for overlays. overlays: their names.
        widest: pixels of width of a still picture at most.
        refresh: called now and then; may return drawings to go on with.
    """

    def __init__(
        self,
        server: Any,
        drawings: Sequence[Drawing],
        bodies: Mapping[str, PosedBody],
        overlays: Sequence[str],
        *,
        widest: int = 1280,
        refresh: Callable[[], Sequence[Drawing] | None] | None = None,
    ) -> None:
        self.server, self.drawings = server, list(drawings)
        first, clip = drawings[0], drawings[0].clip
        self.clip, self.up = clip, clip.up().double().numpy()
        self.clock = Clock(clip.num_frames, clip.fps)
        self.settings = Settings.initial(first.modes, first.names)
        if len(drawings) > 1:
            self.settings.layout, self.settings.other = "beside", "run"
        self._wake, self._jobs = threading.Event(), queue.SimpleQueue[tuple[Eye, str]]()
        self._stopped, self._widest = False, widest
        self._refresh, self._refreshed = refresh, 0.0
        self._eyes: dict[int, Eye] = {}
        self._films: dict[Eye, takes.Film] = {}  # in the making
        self._version, self._told = 0, 0.0
        self._anchor: tuple[str | None, float] = (None, 0.0)  # what was followed, and its frame
        self.path = takes.Path()
        server.scene.set_up_direction(tuple(self.up))
        self.overlays = Overlays(server.scene, clip, bodies)
        self.controls = Controls(
            server.gui, first, self.settings, self.clock, overlays,
            wake=self._wake.set, act=self._act,
        )  # fmt: skip
        self._distance = takes.distance_to_subject(clip)
        start = View.of_camera(clip.cameras[0], self._distance, (640, 480))
        server.initial_camera.position, server.initial_camera.look_at = start.position, start.target
        server.initial_camera.up, server.initial_camera.fov = self.up, start.fov
        server.on_client_connect(self._connect)
        server.on_client_disconnect(lambda client: self._eyes.pop(client.client_id, None))

    def serve(self) -> None:
        """Draw until `stop`."""
        try:
            while not self._stopped:
                if not self.turn():
                    self._wake.wait(IDLE_S)
                    self._wake.clear()
        finally:
            for film in self._films.values():
                film.cancel()

    def stop(self) -> None:
        self._stopped = True
        self._wake.set()

    def turn(self) -> bool:
        """Do what is due; whether anything was drawn."""
        now = time.monotonic()
        self._poll(now)
        while not self._jobs.empty():
            eye, action = self._jobs.get()
            with eye.apart():
                self._take(action, eye)
        with self.controls.lock:
            if self.settings.needs_video and not self.settings.video:
                self.settings.video = self.controls.video.value = True
            settings = replace(
                self.settings, entities=set(self.settings.entities),
                overlays=set(self.settings.overlays),
            )  # fmt: skip
            frame = self.clock.frame(now)
            self.controls.show_time(frame, now)
        self.overlays.update(settings.overlays, frame)
        drew = False
        for eye in list(self._eyes.values()):
            if eye.ready(now):
                with eye.apart():
                    self._follow(eye, settings, frame)
                    drew |= self._draw_for(eye, settings, frame, now)
        for eye in list(self._films):
            with eye.apart():
                drew |= self._go_on(eye)
        self._anchor = (settings.follow, frame)
        return drew

    def _connect(self, client: Any) -> None:
        eye = Eye(client, self._widest, self._dragged)
        self._eyes[client.client_id] = eye

        # in viser's loop: in a thread of its own the drawing could set another camera before it
        @client.camera.on_update
        async def _(_: Any) -> None:
            eye.moved()
            self._wake.set()

        self._wake.set()

    def _dragged(self, eye: Eye) -> None:
        """A person has moved the camera: it is no longer that of the video."""
        if self.settings.video and self.drawings[0].anywhere and not self.settings.needs_video:
            self.controls.leave_video()
            eye.client.camera.up_direction = self.up
        elif self.settings.video and not self.drawings[0].anywhere:
            self.controls.leave_video()

    def _follow(self, eye: Eye, settings: Settings, frame: float) -> None:
        """Bring the browser's camera to that of the video, or along with what it orbits."""
        if settings.video:
            camera = camera_between(self.clip, frame)
            view = View.of_camera(camera, self._distance, eye.canvas)
            if not view.near(eye.view, 1e-4) or abs(view.fov - eye.view.fov) > 1e-4:
                eye.look(view)
        elif settings.follow is not None:
            whom, since = self._anchor
            goal = takes.center(self.drawings[0], settings.follow, frame)
            view = eye.view
            if whom != settings.follow:
                eye.look(takes.turned_to(view, goal, self.up))
            elif since != frame:
                before = takes.center(self.drawings[0], settings.follow, since)
                eye.look(view.moved(goal - before))

    def _draw_for(self, eye: Eye, settings: Settings, frame: float, now: float) -> bool:
        if not self.drawings[0].anywhere and not settings.video:
            return self._clear(eye)
        key = (frame, settings.key(), eye.pose_key(), self._version)
        changed = key != eye.drawn
        if changed:
            eye.changed = now
        elif eye.full or now - eye.changed < STILL_S:
            return False
        size = eye.resolution.size(eye.canvas, moving=changed)
        began = time.monotonic()
        picture = self.picture(size, settings, frame, eye.view)
        quality = JPEG[changed]
        depth = None if picture.depth is None else _thinned(picture.depth)
        eye.client.scene.set_background_image(
            picture.image, format="jpeg", jpeg_quality=quality, depth=depth
        )
        eye.client.flush()
        took = time.monotonic() - began
        if changed:
            eye.resolution.took(took)
            eye.rates.append(time.monotonic())
        eye.drawn, eye.full = key, not changed
        self._tell(eye, size, changed, took, now)
        return True

    def _clear(self, eye: Eye) -> bool:
        """Of a clip nothing can be drawn from here but its 3D nodes."""
        if eye.drawn is not None or not eye.full:
            eye.client.scene.set_background_image(None)
            eye.drawn, eye.full = None, True
        return False

    def picture(
        self, size: tuple[int, int], settings: Settings, frame: float, view: View
    ) -> Picture:
        """What a browser sees, at any size."""

        def camera_of(canvas: tuple[int, int]) -> Camera:
            if settings.video:
                return fitted(camera_between(self.clip, frame), canvas)
            return view.camera(canvas)

        first, look = self.drawings[0], settings.look
        if settings.layout == "one":
            depth = bool(settings.overlays) and not settings.see_through
            return first.draw(frame, camera_of(size), look, depth)

        def draw_first(camera: Camera) -> UInt8[np.ndarray, "H W 3"]:
            return first.draw(frame, camera, look).image

        def draw_second(camera: Camera) -> UInt8[np.ndarray, "H W 3"]:
            if settings.other == "video":
                return source_frame(self.clip, frame, camera)
            second = self.drawings[1]
            time_ = moment_between(self.clip, frame).time
            there = frame_of(second.clip, replace(second.clip.moments[0], time=time_))
            names = frozenset(second.names) & look.entities
            return second.draw(there, camera, replace(look, entities=names)).image

        return Picture(
            joined(settings.layout, settings.share, size, camera_of, draw_first, draw_second)
        )

    def _tell(self, eye: Eye, size: tuple[int, int], moving: bool, took: float, now: float) -> None:
        """The line at the top of the panel, twice a second at most, and for every still picture."""
        if moving and now - self._told < 0.5:
            return
        self._told = now
        rate = f"{eye.rate():.0f} frames/s" if moving else f"{1000 * took:.0f} ms"
        state = "moving" if moving else "still"
        lines = [*(d.title for d in self.drawings), f"{size[0]}x{size[1]}, {state}, {rate}"]
        if self.settings.mode == "velocity" and isinstance(self.drawings[0], RunDrawing):
            lines.append(f"red is {self.drawings[0].top_speed():.2g} m/s or more")
        text = "  \n".join(lines)
        if self.controls.status.content != text:
            self.controls.status.content = text

    def _poll(self, now: float) -> None:
        """Go on with a newer checkpoint, if there is one."""
        if self._refresh is None or now - self._refreshed < 1.0:
            return
        self._refreshed = now
        newer = self._refresh()
        if newer is not None:
            self.drawings = list(newer)
            self._version += 1

    def _act(self, action: str, client: Any) -> None:
        """A button was pressed: the drawing thread does the work."""
        eye = self._eyes.get(client.client_id) if client is not None else None
        if eye is not None:
            self._jobs.put((eye, action))
            self._wake.set()

    def _take(self, action: str, eye: Eye) -> None:
        """Do what a button says, in the drawing thread."""
        frame = self.clock.frame(time.monotonic())
        if action == "screenshot":
            image = self.picture(eye.canvas, self.settings, frame, eye.view).image
            eye.client.send_file_download(
                f"hoigs_{frame:07.2f}.png", takes.png(image), save_immediately=True
            )
            return
        if action == "add key":
            if len(self.path.keys) < takes.MOST_KEYS:
                self.path.keys.append((frame, eye.view))
        elif action == "clear keys":
            self.path.keys.clear()
        elif action == "film" and len(self.path.keys) > 1 and eye not in self._films:
            self._films[eye] = self._film(eye)
        self.controls.keys.content = str(self.path)

    def _film(self, eye: Eye) -> takes.Film:
        """A film of the path, to be drawn a picture at a time."""
        settings = replace(self.settings, video=False, overlays=set())
        if settings.needs_video:  # which a path leaves
            settings = replace(settings, layout="one", mode="colour")
        size = eye.resolution.size(eye.canvas, moving=False)
        width, height = (max(n // 2 * 2, 2) for n in size)

        def draw(frame: float, view: View) -> UInt8[np.ndarray, "H W 3"]:
            return self.picture((width, height), settings, frame, view).image

        return takes.Film(self.path, self.controls.seconds.value, draw)

    def _go_on(self, eye: Eye) -> bool:
        """Draw the next picture of a film, or give the browser what is done; whether it was drawn.

        A film that fails is over, and so is that of a browser that has left.
        """
        film = self._films.pop(eye)
        if eye.client.client_id not in self._eyes:
            film.cancel()
            return False
        before = film.drawn
        try:
            done = film.step()
        except Exception:
            film.cancel()
            raise
        if done is not None:
            eye.client.send_file_download("hoigs_path.mp4", done, save_immediately=True)
            self.controls.keys.content = str(self.path)
            return True
        self._films[eye] = film
        if film.drawn % 10 == 1:
            self.controls.keys.content = f"Filming: {100 * film.drawn // film.count} %"
        return film.drawn > before


def _thinned(depth: np.ndarray) -> np.ndarray:
    """A depth map with at most DEPTH_WIDTH columns: nothing is interpolated across edges."""
    every = max(1, -(-depth.shape[1] // DEPTH_WIDTH))
    return depth[::every, ::every]
