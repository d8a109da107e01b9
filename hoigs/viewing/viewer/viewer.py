"""Viewer: draws for every visitor what their own panel asks for."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import UInt8

from hoigs.core.values.between import camera_between, frame_of, in_shape, moment_between
from hoigs.core.values.camera import Camera
from hoigs.viewing.viewer import takes
from hoigs.viewing.viewer.controls import Clock, Controls, Settings
from hoigs.viewing.viewer.eyes import STILL_S, Eye
from hoigs.viewing.viewer.overlays import AT_THE_CAMERA, IN_PLACE_OF_FRAMES, Overlays, PosedBody
from hoigs.viewing.viewer.panes import Draw, inner_rectangle, joined, source_frame
from hoigs.viewing.viewer.run_drawing import FAR, Drawing, Picture, RunDrawing
from hoigs.viewing.viewer.views import View

IDLE_S = 0.05  # between looks at the clock and the cameras while nothing happens
DEPTH_WIDTH = 400  # pixels of the depth that is sent, which hides overlays behind the picture
JPEG = {True: 80, False: 93}  # quality of a moving and of a still picture
AROUND = 20  # grey beside the video's frame, that of the page
ABOVE_FLOOR = 0.05  # metres that a camera stays above it
PHONE = 600  # pixels of width, below which the panel's folders are closed at first


@dataclass
class Visit:
    """One visitor: browser, panel, clock and everything that was chosen; nobody else's.

    Attributes:
        anchor: what was followed, and its frame. film: in the making. told: when the panel's first
            line was written, seconds.
    """

    eye: Eye
    settings: Settings
    clock: Clock
    controls: Controls
    overlays: Overlays
    path: takes.Path = field(default_factory=takes.Path)
    anchor: tuple[str | None, float] = (None, 0.0)
    film: takes.Film | None = None
    told: float = 0.0


class Viewer:
    """One server, its visitors, and the thread that draws (the one that calls `serve`).

    Args:
        server: viser's. drawings: one or two; clocks are of the first one's clip.
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
        clip = drawings[0].clip
        self.clip, self.up = clip, clip.up().double().numpy()
        self._bodies, self._offered = bodies, overlays
        self._wake, self._jobs = threading.Event(), queue.SimpleQueue[tuple[Visit, str]]()
        self._stopped, self._widest = False, widest
        self._refresh, self._refreshed = refresh, 0.0
        self.visits: dict[int, Visit] = {}  # by viser's number of the client
        self._version = 0
        server.scene.set_up_direction(tuple(self.up))
        self._distance = takes.distance_to_subject(clip)
        start = View.of_camera(clip.cameras[0], self._distance, (640, 480))
        server.initial_camera.position, server.initial_camera.look_at = start.position, start.target
        server.initial_camera.up, server.initial_camera.fov = self.up, start.fov
        server.on_client_connect(self._connect)
        server.on_client_disconnect(self._leave)

    def initial(self) -> Settings:
        """What a new visitor sees: the video's own camera; a drag orbits about the person."""
        first = self.drawings[0]
        settings = Settings(first.modes[0], set(first.names))
        moving = [name for name in first.names if name != "scene"]
        people = [name for name in moving if self.clip.kinds.get(name) == "human"]
        settings.follow = next(iter(people or moving), None)
        if len(self.drawings) > 1:
            settings.layout, settings.other = "beside", "run"
        return settings

    def serve(self) -> None:
        """Draw until `stop`."""
        try:
            while not self._stopped:
                if not self.turn():
                    self._wake.wait(IDLE_S)
                    self._wake.clear()
        finally:
            for visit in self.visits.values():
                if visit.film is not None:
                    visit.film.cancel()

    def stop(self) -> None:
        self._stopped = True
        self._wake.set()

    def turn(self) -> bool:
        """Do what is due; whether anything was drawn."""
        now = time.monotonic()
        self._poll(now)
        while not self._jobs.empty():
            visit, action = self._jobs.get()
            with visit.eye.apart():
                self._take(action, visit)
        drew = False
        for visit in list(self.visits.values()):
            if visit.eye.ready(now):
                with visit.eye.apart():
                    drew |= self._turn_of(visit, now)
            if visit.film is not None:
                with visit.eye.apart():
                    drew |= self._go_on(visit, visit.film)
        return drew

    def _turn_of(self, visit: Visit, now: float) -> bool:
        """Do what is due for one visitor; whether a picture was drawn."""
        controls, chosen = visit.controls, visit.settings
        with controls.lock:
            if chosen.needs_video and not chosen.video:
                chosen.video = controls.video.value = True
            settings = replace(chosen, entities=set(chosen.entities), overlays=set(chosen.overlays))
            frame = visit.clock.frame(now)
            controls.show_time(frame, now)
        # what is drawn at the camera would cover all that it sees
        shown = settings.overlays - AT_THE_CAMERA if settings.video else settings.overlays
        visit.overlays.update(shown, frame)
        self._follow(visit, settings, frame)
        visit.anchor = (None if settings.video else settings.follow, frame)
        return self._draw_for(visit, settings, frame, now)

    def _connect(self, client: Any) -> None:
        eye = Eye(client, self._widest, lambda _: self._dragged(visit))
        settings, clock = self.initial(), Clock(self.clip.num_frames, self.clip.fps)
        controls = Controls(
            client.gui, self.drawings[0], settings, clock, self._offered, wake=self._wake.set,
            act=lambda action: self._act(action, visit), folded=eye.canvas[0] < PHONE,
        )  # fmt: skip
        overlays = Overlays(client.scene, self.clip, self._bodies)
        visit = Visit(eye, settings, clock, controls, overlays)
        self.visits[client.client_id] = visit

        # in viser's loop: in a thread of its own the drawing could set another camera before it
        @client.camera.on_update
        async def _(_: Any) -> None:
            eye.moved()
            self._wake.set()

        self._wake.set()

    def _leave(self, client: Any) -> None:
        visit = self.visits.pop(client.client_id, None)
        if visit is not None and visit.film is not None:
            visit.film.cancel()

    def _dragged(self, visit: Visit) -> None:
        """A person has moved the camera: it is no longer that of the video. What a clip has in 3D
        takes the place of its frames."""
        settings, anywhere = visit.settings, self.drawings[0].anywhere
        if settings.video and not (anywhere and settings.needs_video):
            visit.controls.leave_video(() if anywhere else IN_PLACE_OF_FRAMES)
            visit.eye.client.camera.up_direction = self.up

    def _follow(self, visit: Visit, settings: Settings, frame: float) -> None:
        """Bring the browser's camera to that of the video, or along with what it orbits; it stays
        above the floor, where one is known."""
        eye = visit.eye
        if settings.video:
            camera = camera_between(self.clip, frame)
            view = View.of_camera(camera, self._distance, eye.canvas)
            if not view.near(eye.view, 1e-4) or abs(view.fov - eye.view.fov) > 1e-4:
                eye.look(view)
        elif settings.follow is not None:
            whom, since = visit.anchor
            goal = takes.center(self.drawings[0], settings.follow, frame)
            view = eye.view
            if whom != settings.follow:
                eye.look(takes.turned_to(view, goal, self.up))
            elif since != frame:
                before = takes.center(self.drawings[0], settings.follow, since)
                eye.look(view.moved(goal - before))
        if not settings.video and self.clip.world.floor is not None:
            view = eye.view
            below = self.clip.world.floor + ABOVE_FLOOR - float(view.position @ self.up)
            if below > 0:
                raised = replace(view, position=view.position + below * self.up)
                eye.look(takes.turned_to(raised, view.target, self.up))

    def _draw_for(self, visit: Visit, settings: Settings, frame: float, now: float) -> bool:
        eye = visit.eye
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
        self._tell(visit, size, changed, took, now)
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
        """What a browser sees, at any size. From the video's camera it is the video's frame and no
        more: nothing is known of what lies beside it."""

        def camera_of(canvas: tuple[int, int]) -> Camera:
            if settings.video:
                return in_shape(camera_between(self.clip, frame), *canvas)
            return view.camera(canvas)

        first, look = self.drawings[0], settings.look
        if settings.layout == "one":
            depth = bool(settings.overlays) and not settings.see_through
            if not settings.video:
                return first.draw(frame, camera_of(size), look, depth)
            inside, place = self._own_frame(frame, size)
            drawn = first.draw(frame, inside, look, depth)
            behind = None if drawn.depth is None else _within(drawn.depth, size, place, FAR)
            return Picture(_within(drawn.image, size, place, AROUND), behind)

        def own(draw: Draw) -> Draw:
            def drawn(camera: Camera) -> UInt8[np.ndarray, "H W 3"]:
                if not settings.video:
                    return draw(camera)
                canvas = camera.width, camera.height
                inside, place = self._own_frame(frame, canvas)
                return _within(draw(inside), canvas, place, AROUND)

            return drawn

        @own
        def draw_first(camera: Camera) -> UInt8[np.ndarray, "H W 3"]:
            return first.draw(frame, camera, look).image

        @own
        def draw_second(camera: Camera) -> UInt8[np.ndarray, "H W 3"]:
            if settings.other == "video":
                return source_frame(self.clip, frame, camera)
            second = self.drawings[1]
            time_ = moment_between(self.clip, frame).time
            there = frame_of(second.clip, replace(second.clip.moments[0], time=time_))
            names = frozenset(second.names) & look.entities
            return second.draw(there, camera, replace(look, entities=names)).image

        layout, share = settings.layout, settings.share
        return Picture(joined(layout, share, size, camera_of, draw_first, draw_second))

    def _own_frame(
        self, frame: float, canvas: tuple[int, int]
    ) -> tuple[Camera, tuple[int, int, int, int]]:
        """The video's camera at the size at which its frame fits into a canvas, and where that is:
        left, top, width and height."""
        camera = camera_between(self.clip, frame)
        place = inner_rectangle((camera.width, camera.height), canvas)
        return in_shape(camera, *place[2:]), place

    def _tell(
        self, visit: Visit, size: tuple[int, int], moving: bool, took: float, now: float
    ) -> None:
        """The line at the top of the panel, twice a second at most, and for every still picture."""
        if moving and now - visit.told < 0.5:
            return
        visit.told = now
        rate = f"{visit.eye.rate():.0f} frames/s" if moving else f"{1000 * took:.0f} ms"
        state = "moving" if moving else "still"
        lines = [*(d.title for d in self.drawings), f"{size[0]}x{size[1]}, {state}, {rate}"]
        if visit.settings.mode == "velocity" and isinstance(self.drawings[0], RunDrawing):
            lines.append(f"red is {self.drawings[0].top_speed():.2g} m/s or more")
        text = "  \n".join(lines)
        if visit.controls.status.content != text:
            visit.controls.status.content = text

    def _poll(self, now: float) -> None:
        """Go on with a newer checkpoint, if there is one."""
        if self._refresh is None or now - self._refreshed < 1.0:
            return
        self._refreshed = now
        newer = self._refresh()
        if newer is not None:
            self.drawings = list(newer)
            self._version += 1

    def _act(self, action: str, visit: Visit) -> None:
        """A button was pressed: the drawing thread does the work."""
        self._jobs.put((visit, action))
        self._wake.set()

    def _take(self, action: str, visit: Visit) -> None:
        """Do what a button says, in the drawing thread."""
        frame, eye = visit.clock.frame(time.monotonic()), visit.eye
        if action == "screenshot":
            image = self.picture(eye.canvas, visit.settings, frame, eye.view).image
            eye.client.send_file_download(
                f"hoigs_{frame:07.2f}.png", takes.png(image), save_immediately=True
            )
            return
        if action == "add key":
            if len(visit.path.keys) < takes.MOST_KEYS:
                visit.path.keys.append((frame, eye.view))
        elif action == "clear keys":
            visit.path.keys.clear()
        elif action == "film" and len(visit.path.keys) > 1 and visit.film is None:
            visit.film = self._film(visit)
        visit.controls.keys.content = str(visit.path)

    def _film(self, visit: Visit) -> takes.Film:
        """A film of the path, to be drawn a picture at a time."""
        eye = visit.eye
        settings = replace(visit.settings, video=False, overlays=set())
        if settings.needs_video:  # which a path leaves
            settings = replace(settings, layout="one", mode="colour")
        size = eye.resolution.size(eye.canvas, moving=False)
        width, height = (max(n // 2 * 2, 2) for n in size)

        def draw(frame: float, view: View) -> UInt8[np.ndarray, "H W 3"]:
            return self.picture((width, height), settings, frame, view).image

        return takes.Film(visit.path, visit.controls.seconds.value, draw)

    def _go_on(self, visit: Visit, film: takes.Film) -> bool:
        """Draw the next picture of a film, or give the browser what is done; whether it was drawn.

        A film that fails is over.
        """
        before = film.drawn
        try:
            done = film.step()
        except Exception:
            film.cancel()
            visit.film = None
            raise
        if done is not None:
            visit.film = None
            visit.eye.client.send_file_download("hoigs_path.mp4", done, save_immediately=True)
            visit.controls.keys.content = str(visit.path)
            return True
        if film.drawn % 10 == 1:
            visit.controls.keys.content = f"Filming: {100 * film.drawn // film.count} %"
        return film.drawn > before


def _within(
    image: np.ndarray, canvas: tuple[int, int], place: tuple[int, int, int, int], around: float
) -> np.ndarray:
    """An image at a place (left, top, width, height) of a canvas (width, height)."""
    left, top, width, height = place
    shape = (canvas[1], canvas[0], *image.shape[2:])
    whole = np.full(shape, around, image.dtype)
    whole[top : top + height, left : left + width] = image
    return whole


def _thinned(depth: np.ndarray) -> np.ndarray:
    """A depth map with at most DEPTH_WIDTH columns: nothing is interpolated across edges."""
    every = max(1, -(-depth.shape[1] // DEPTH_WIDTH))
    return depth[::every, ::every]
